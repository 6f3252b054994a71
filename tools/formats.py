"""Bytes of one stream in the formats of others, what is left of its pictures, and what decoding takes.

Usage: python -m tools.formats STREAM [--frames N] [--take NAME --commit HASH]

Every format holds the same decoded frames. Pictures of test cameras are drawn by our renderer from the numbers that a
reader of the format gives, and compared with ours: mean decibels over at most five frames. Decoding is processor time a
frame, of all frames, the least of three tries; readers are Python packages, so it says little about other languages.
Needs fourdgs and usd-core; splats4d (pip) and splat-transform (npm) where they are installed. With --take the rows go
to "formats-NAME.jsonl" in docs/results/data, with the commit that encoded the stream.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsstream.play import Playback, render
from tools.foreign import Read, Scene, Written, deltas, gltf, lives, numbered, splats4d, usd

DATA = Path(__file__).parents[1] / "docs" / "results" / "data"
#: Decibels beyond which two pictures differ by rounding alone.
EQUAL = 100.0


def decibels(playback: Playback, frames: Sequence[int], written: Written) -> float | str:
    """Mean over test cameras and some frames of ours against those of a format."""
    if written.scene is None:
        return "-"
    chosen = sorted({round(n) for n in np.linspace(0, len(frames) - 1, 5)})
    if written.read is None:
        scenes = {n: written.scene(n) for n in chosen}
    else:
        scenes = {n: written.scene(values) for n, values in enumerate(written.read()) if n in chosen}
    rig, found = playback.cameras("test"), []
    moved = playback.meta.world.cameras(rig)
    moved = dataclasses.replace(moved, viewmats=moved.viewmats @ written.to_recording)
    for number, scene in scenes.items():
        ours = playback.state_at(frames[number])
        for view in range(len(rig)):
            one, other = (render(s, r, view, playback.meta.background) for s, r in ((ours, rig), (scene, moved)))
            error = float(np.mean((np.clip(one, 0, 1) - np.clip(other, 0, 1)) ** 2))
            found.append(-10 * math.log10(max(error, 1e-12)))
    mean = sum(found) / len(found)
    return round(mean, 1) if mean < EQUAL else f"over {EQUAL:.0f}"


def decoding(read: Read | None, frames: int) -> float | None:
    """Processor milliseconds a frame; None where the reader is another program."""
    if read is None:
        return None
    tries = []
    for _ in range(3):
        start = time.process_time()
        for _ in read():
            pass
        tries.append(time.process_time() - start)
    return round(1000 * min(tries) / frames, 1)


def measure(stream: Path, count: int | None, folder: Path) -> Iterator[dict[str, Any]]:
    """Yield a row for each format."""
    with Playback(stream) as playback:
        frames = list(playback.frames)[:count]
        fps, degree = playback.meta.fps, math.isqrt(playback.state_at(frames[0]).shN.shape[1] + 1) - 1
        ours = sum(playback.entry(frame).size for frame in frames)
        key, gaussians = playback.entry(frames[0]).size, len(playback.state_at(frames[0]))
        facts = {"frames": len(frames), "Gaussians": gaussians}

        def read() -> Iterator[Scene]:
            with Playback(stream) as fresh:
                yield from (fresh.state_at(frame) for frame in frames)

        head = {"format": "gsstream", "KB": round(ours / 1e3), "KB_per_frame": round(ours / 1e3 / len(frames), 1)}
        shown = {"of_ours": 1.0, "degree": degree, "dB": "all bits", "read_by": "gsstream"}
        yield facts | head | shown | {"CPU_ms_per_frame": decoding(read, len(frames)), "key_KB": round(key / 1e3)}
        made: list[Written | None] = [
            lives(stream, frames, folder, degree, fps),
            deltas(stream, frames, folder, fps),
            splats4d(stream, frames, folder, fps),
            *numbered(stream, frames, folder, degree),
            gltf(stream, frames, folder, degree),
            usd(stream, frames, folder, degree),
        ]
        for written in filter(None, made):
            size = sum(file.stat().st_size for file in written.files)
            head = {"format": written.name, "KB": round(size / 1e3)}
            head |= {"KB_per_frame": round(size / 1e3 / len(frames), 1), "of_ours": round(size / ours, 1)}
            shown = {"degree": written.degree, "dB": decibels(playback, frames, written), "read_by": written.read_by}
            yield facts | head | shown | {"CPU_ms_per_frame": decoding(written.read, len(frames)) or "-"}


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure one stream."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stream", type=Path)
    parser.add_argument("--frames", type=int)
    parser.add_argument("--take", metavar="NAME")
    parser.add_argument("--commit", default="unknown")
    given = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory() as folder:
        rows = []
        for row in measure(given.stream, given.frames, Path(folder)):
            rows.append(json.dumps(row | {"load": round(os.getloadavg()[0]), "commit": given.commit}))
            print(rows[-1], flush=True)
    if given.take is not None:
        (DATA / f"formats-{given.take}.jsonl").write_text("".join(f"{row}\n" for row in rows), encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
