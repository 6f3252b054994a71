"""Does a long stream drift? Encode a looped recording, play the file, compare every frame bit by bit; slope of PSNR.

Usage: python -m tools.drift --source demo --frames 300 --out DIR [--method s2gs-edge] [--recipe FILE] [--set
KEY=VALUE ...]

The recording runs there and back again, so that no frame jumps. Writes stream.gss, and drift.json with one line of
numbers per frame; the exit code is 1 when player and encoder differ in a single bit.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gsstream.core.errors import OutputError
from gsstream.core.gaussians import Gaussians
from gsstream.core.shapes import FloatArray
from gsstream.engine.assembly.assemble import Assembly, assemble
from gsstream.engine.frame0.points import gather_points
from gsstream.engine.run.encoder import Encoder
from gsstream.engine.run.measure import HeldOut
from gsstream.engine.run.recording import open_recording
from gsstream.input.recordings.base import FrameSource, Split
from gsstream.method.base import MethodState
from gsstream.metrics.trend import slope_per_100
from gsstream.packet import StreamWriter
from gsstream.player.playback import Playback
from gsstream.plugins.catalog import load_catalog
from gsstream.recipe.load import resolve_recipe

SPLITS: tuple[Split, ...] = ("train", "test")


@dataclass(frozen=True)
class Drift:
    """What a long run came to.

    Arguments:
        frames: one record per frame: kind, bytes, psnr and psnr_moving on the test cameras (None: undefined), same
            (whether the player's scene equals the encoder's, bit for bit).
    """

    frames: tuple[dict[str, Any], ...]

    @property
    def different(self) -> list[int]:
        """Frames in which player and encoder differ."""
        return [index for index, frame in enumerate(self.frames) if not frame["same"]]

    def slope(self, name: str) -> float:
        """dB per 100 frames over all frames but the first in which the number is defined."""
        rows = [(i, frame[name]) for i, frame in enumerate(self.frames) if i and frame[name] is not None]
        return slope_per_100([i for i, _ in rows], [value for _, value in rows])

    def mean(self, name: str, first: int, last: int) -> float | None:
        """Mean over frames [first, last)."""
        values = [frame[name] for frame in self.frames[first:last] if frame[name] is not None]
        return float(np.mean(values)) if values else None

    def summary(self, period: int) -> dict[str, Any]:
        """The numbers of a table; ``period``: frames after which the loop repeats."""
        total, later = len(self.frames), [f["bytes"] for f in self.frames[1:] if f["kind"] != "key"]
        last = (total - 1) // period * period + 1  # full periods after frame 0 end before this frame
        ends = {"first_period": (1, 1 + period), "last_period": (max(1, last - period), last)}
        return {
            "frames": total, "period": period, "different_frames": self.different,
            "kb_per_frame": sum(later) / 1000 / max(1, len(later)),
            **{f"{name}_slope_db_per_100": self.slope(name) for name in ("psnr", "psnr_moving")},
            **{f"{n}_{end}": self.mean(n, *span) for n in ("psnr", "psnr_moving") for end, span in ends.items()},
        }  # fmt: skip


def there_and_back(index: int, length: int) -> int:
    """Frame of a recording of ``length`` frames to show at ``index``: 0, 1, ..., length - 1, ..., 1, 0, 1, ..."""
    if length == 1:
        return 0
    place = index % (2 * length - 2)
    return min(place, 2 * length - 2 - place)


def measure_drift(parts: Assembly, source: FrameSource, frames: int, out: Path) -> Drift:
    """Encode ``frames`` frames of the looped recording into ``out`` and play them. Raises OutputError if it exists."""
    stream = out / "stream.gss"
    if stream.exists():
        raise OutputError(f"{stream} exists; choose another place")
    out.mkdir(parents=True, exist_ok=True)
    records, digests = [], []
    with StreamWriter.open(stream) as writer:
        for kind, size, quality, state in _encode(parts, source, frames, writer):
            values = {n: [v for v in quality.get(n, {}).values() if v is not None] for n in ("psnr", "psnr_moving")}
            means = {name: float(np.mean(found)) if found else None for name, found in values.items()}
            records.append({"kind": kind, "bytes": size, **means})
            digests.append(digest(state.player.gaussians))
    with Playback(stream) as playback:
        same = [digest(scene) == theirs for (_, scene), theirs in zip(playback, digests, strict=True)]
    return Drift(tuple({**record, "same": equal} for record, equal in zip(records, same, strict=True)))


def digest(gaussians: Gaussians[FloatArray]) -> str:
    """SHA-256 of all attributes."""
    return hashlib.sha256(b"".join(np.ascontiguousarray(value).tobytes() for _, value in gaussians.items())).hexdigest()


def _encode(
    parts: Assembly, source: FrameSource, frames: int, writer: StreamWriter
) -> Iterator[tuple[str, int, dict[str, Any], MethodState]]:
    length, settings = source.info.num_frames or 1, parts.recipe.first_frame
    held_out = HeldOut(parts.renderer, parts.recipe.background)
    encoder = Encoder(
        parts, source.info, lambda frame: gather_points(source.points, frame, settings, encoder.rng)
    )
    for index in range(frames):
        at = there_and_back(index, length)
        train, test = (replace(source.frame(at, split), index=index) for split in SPLITS)
        step = encoder.encode(train)
        quality = held_out.measure(step.state, encoder.with_near_plane(test)) if len(test.cameras) else {}
        yield step.status, writer.append(step.packet), quality, step.state


def main(arguments: Sequence[str] | None = None) -> int:
    """Run as a command; returns the exit code."""
    import torch

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", default="demo")
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--method", default="s2gs-edge")
    parser.add_argument("--recipe", type=Path, action="append", default=[])
    parser.add_argument("--set", action="append", default=[], dest="sets", metavar="KEY=VALUE")
    given = parser.parse_args(arguments)
    torch.set_num_threads(1)
    catalog = load_catalog()
    recipe = resolve_recipe(given.method, catalog.recipe_path, given.recipe, [("--set", text) for text in given.sets])
    parts = assemble(recipe, catalog)
    source = open_recording(given.source, parts.recipe, catalog)
    drift = measure_drift(parts, source, given.frames, given.out)
    summary = drift.summary(max(1, 2 * (source.info.num_frames or 1) - 2))
    text = json.dumps({"summary": summary, "frames": drift.frames}, indent=1)
    (given.out / "drift.json").write_text(text + "\n", encoding="utf-8")
    print(json.dumps(summary, indent=1))
    return 1 if drift.different else 0


if __name__ == "__main__":
    sys.exit(main())
