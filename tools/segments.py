"""Measure a recording that is encoded in segments, which could run at the same time, against the same in one piece.

    python -m tools.segments RECORDING --frames 30 --length 10 --out DIR [--method s2gs-edge] [--set KEY=VALUE ...]

Each segment begins with a key packet. Where its scene comes from is a *leap*: from the key frame before it straight to
its own, as if that were the next frame, with every gate open and several times the passes; only what changed between
the two key frames is a candidate, as in every frame. The leaps are a chain, everything else of a segment waits for
nothing but its own.

Written to DIR: whole.gss, segments.gss, and rows.jsonl with one line for each of the two: quality by the test cameras,
flicker (levels of still pixels between decoded frames) at the seams and elsewhere, and how many times as fast the later
frames would be with a machine for each segment, by seconds of the processor.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from gsstream_lab.extras import extras

from gsstream.discovery.catalog import load_catalog
from gsstream.encode import Encoder, Source, StreamWriter
from gsstream.engine.assembly.assemble import assemble
from gsstream.engine.frame0.points import gather_points
from gsstream.engine.run.recording import open_recording
from gsstream.evaluation.evaluate import Evaluation, evaluate
from gsstream.evaluation.records import mean
from gsstream.packet import EncodedPacket, PlayerState, decode_packet
from gsstream.recipe.load import ResolvedRecipe, resolve_recipe

#: Passes of a leap, in those of a later frame; what leaps with open gates were given when they were measured first.
LEAP = 9
ARMS = ("whole", "segments")


@dataclass(frozen=True)
class Made:
    """Packets, and seconds of the processor: of the leaps, and of the later frames of each segment."""

    packets: list[EncodedPacket]
    leaps: list[float]
    later: list[list[float]]

    def all_later(self) -> list[float]:
        """Seconds of every later frame."""
        return [seconds for steps in self.later for seconds in steps]

    def longest_later(self) -> float:
        """Seconds from frame 0 to the end of the last segment, if each has a machine; leaps follow each other."""
        begun = [sum(self.leaps[:k]) for k in range(len(self.later))]
        return max(start + sum(steps) for start, steps in zip(begun, self.later, strict=True))


def main() -> None:
    """Encode both, unless their streams are there, and write the rows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording")
    parser.add_argument("--frames", type=int, required=True)
    parser.add_argument("--length", type=int, required=True, help="frames of a segment")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--method", default="s2gs-edge")
    parser.add_argument("--recipe", type=Path, action="append", default=[])
    parser.add_argument("--set", dest="settings", action="append", default=[])
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    recipe = Recipes(asked.method, asked.recipe, asked.settings)
    source = open_recording(asked.recording, recipe.resolved().recipe, load_catalog())
    whole = encoded(source, recipe, frames=asked.frames, length=asked.frames)
    pieces = encoded(source, recipe, frames=asked.frames, length=asked.length, first=whole.packets[0])
    rows = []
    for name, made in zip(ARMS, (whole, pieces), strict=True):
        path = asked.out / f"{name}.gss"
        path.unlink(missing_ok=True)
        with StreamWriter.open(path) as writer:
            for packet in made.packets:
                writer.append(packet)
        quality = evaluate(path, source, extras=extras(["flicker"]))
        rows.append({"recording": source.info.name} | row(made, quality, whole, length=asked.length))
        print(json.dumps(rows[-1]), flush=True)
    (asked.out / "rows.jsonl").write_text("".join(json.dumps(line) + "\n" for line in rows), encoding="utf-8")


@dataclass(frozen=True)
class Recipes:
    """What the command line says of the recipe."""

    method: str
    files: list[Path]
    settings: list[str]

    def resolved(self, *more: str) -> ResolvedRecipe:
        """The recipe, with further settings."""
        changes = [("--set", text) for text in (*self.settings, *more)]
        return resolve_recipe(self.method, load_catalog().recipe_path, self.files, changes)

    def encoder(self, source: Source, scene: PlayerState | None, *more: str) -> Encoder:
        """An encoder whose first frame is a scene that there is; None: that makes its own."""
        assembly = assemble(self.resolved(*more), load_catalog())
        points = partial(gather_points, source, settings=assembly.recipe.first_frame)
        return Encoder(assembly, source.info, points, first_frame=scene)


def encoded(source: Source, recipe: Recipes, *, frames: int, length: int, first: EncodedPacket | None = None) -> Made:
    """Encode in segments of ``length``; ``first``: the packet of a frame 0 that is made already."""
    scene = None if first is None else decode_packet(None, first.data)
    packets, later, leaps = list[EncodedPacket](), list[list[float]](), list[float]()
    for begin in range(0, frames, length):
        if scene is not None and begin:
            scene, seconds = leap(recipe, source, scene=scene, at=begin)
            leaps.append(seconds)
        steps = list(timed(recipe.encoder(source, scene), source, begin, min(begin + length, frames)))
        scene = decode_packet(None, steps[0][0].data)
        packets += [packet for packet, _ in steps]
        later.append([seconds for _, seconds in steps[1:]])
    return Made(packets, leaps, later)


def timed(encoder: Encoder, source: Source, begin: int, end: int) -> Iterator[tuple[EncodedPacket, float]]:
    """Packets of frames with the processor's seconds of each."""
    for index in range(begin, end):
        frame = source.frame(index)
        began = time.process_time()
        packet = encoder.encode(frame).packet
        yield packet, time.process_time() - began
        print(f"frame {index}: {len(packet.data)} bytes, {time.process_time() - began:.1f} s", flush=True)


def leap(recipe: Recipes, source: Source, *, scene: PlayerState, at: int) -> tuple[PlayerState, float]:
    """Return the scene of frame ``at``, made from that of the key frame before it in one step, and its seconds."""
    epochs = LEAP * recipe.resolved().recipe.stream.epochs
    encoder = recipe.encoder(source, scene, "gate=always-open", f"stream.epochs={epochs}")
    encoder.encode(replace(source.frame(scene.frame), index=0, timestamp=0.0))
    after = replace(source.frame(at), index=1, timestamp=1 / source.info.fps)
    began = time.process_time()
    step = encoder.encode(after)
    seconds = time.process_time() - began
    print(f"leap to {at}: {seconds:.1f} s", flush=True)
    return step.state.player, seconds


def row(made: Made, quality: Evaluation, whole: Made, *, length: int) -> dict[str, Any]:
    """What the results page shows of one stream. Its speed is that of the later frames, frame 0 left out on both sides.

    The model of speed: a segment takes the leaps up to its own, of LEAP frames each, and its frames.
    """
    frames = len(made.packets)
    seams = set(range(length, frames, length))

    def over(key: str) -> float:
        return mean(getattr(view, key) for view in quality.views if view.frame)

    def flicker(chosen: set[int]) -> float:
        return mean(view.extra["flicker"] for view in quality.views if view.frame in chosen)

    speed_up = whole.longest_later() / made.longest_later()
    model = frames / max(LEAP * place + len(steps) + 1 for place, steps in enumerate(made.later))
    leaps = {"frames_of_a_leap": round(mean(made.leaps) / mean(made.all_later()), 1)} if made.leaps else {}
    return leaps | {
        "frames": frames,
        "segments_of": len(made.later[0]) + 1,
        "PSNR_dB": round(over("psnr"), 2),
        "changed_dB": round(over("psnr_changed"), 2),
        "flicker_at_seams": round(flicker(seams), 2),
        "flicker_elsewhere": round(flicker(set(range(1, frames)) - seams), 2),
        "KB_a_frame": round(sum(len(packet.data) for packet in made.packets[1:]) / 1000 / (frames - 1), 1),
        "times_as_fast": round(speed_up, 2),
        "of_the_model": round(speed_up / model, 2),
    }


if __name__ == "__main__":
    main()
