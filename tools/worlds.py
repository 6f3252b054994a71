"""Does it matter in which coordinates a recording comes? Encode one in several similar worlds, and compare.

Usage: python -m tools.worlds [--source demo] [--method s2gs-fast] [--set KEY=VALUE ...] [--rows NAME ...]
[--seeds 0 1 2] [--as-filed]

Prints a table: as it is with several seeds, then moved, scaled and turned with the first one. ``--as-filed`` leaves the
recording in the coordinates it comes in, which is what docs/adr/0010 keeps a run from.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from gsstream.core.frame import Frame, PointCloud
from gsstream.core.gaussians import ATTRIBUTES
from gsstream.core.world import IDENTITY, World
from gsstream.engine.assembly.assemble import Assembly, assemble
from gsstream.engine.frame0.points import gather_points
from gsstream.engine.run.encoder import Encoder
from gsstream.engine.run.measure import HeldOut
from gsstream.input.recordings.base import FrameSource, PointKind, SourceInfo, Split
from gsstream.input.recordings.canonical import CanonicalSource, recording_similarity
from gsstream.input.recordings.open import open_source
from gsstream.input.recordings.transformed import transformed
from gsstream.plugins.catalog import load_catalog
from gsstream.recipe.load import resolve_recipe


class Moved:
    """A recording whose calibration and points were written in another world: the same pictures.

    Arguments:
        source: an open recording.
        world: leads from its coordinates to the new ones.
    """

    def __init__(self, source: FrameSource, world: World) -> None:
        self._source, self._world = source, world

    @property
    def info(self) -> SourceInfo:
        """The recording's, with its cameras moved."""
        info = self._source.info
        return replace(info, train=self._world.cameras(info.train), test=self._world.cameras(info.test))

    def frame(self, index: int, split: Split = "train") -> Frame:
        """Read one instant."""
        frame = self._source.frame(index, split)
        return replace(frame, cameras=self._world.cameras(frame.cameras))

    def points(self, kind: PointKind = "recording") -> PointCloud | None:
        """Return the recording's points, moved, in float64."""
        cloud = self._source.points(kind)
        return None if cloud is None else replace(cloud, xyz=self._world.points(cloud.xyz))

    def close(self) -> None:
        """Close the recording."""
        self._source.close()


def world(scale: float = 1.0, offset: Sequence[float] = (0.0, 0.0, 0.0), turn: int | None = None) -> World:
    """Return a similarity."""
    if turn is None:
        return World(IDENTITY.rotation, tuple(float(value) for value in offset), scale)
    w, x, y, z = (lambda q: q / np.linalg.norm(q))(np.random.default_rng(turn).normal(size=4))
    rotation = (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip
    return World(tuple(map(float, rotation)), tuple(float(value) for value in offset), scale)


ROWS = {
    "millimetres (x 1e3)": world(1e3), "kilometres (x 1e-3)": world(1e-3), "x 1e9": world(1e9),
    "x 1e-6": world(1e-6), "moved by 1e3": world(offset=(1e3, -1e3, 1e3)),
    "moved by 1e5": world(offset=(1e5, 1e5, -1e5)), "moved by 1e7": world(offset=(-1e7, 1e7, 1e7)),
    "UTM (5e5, 5.2e6, 300)": world(offset=(5e5, 5.2e6, 300)), "turned (1)": world(turn=1), "turned (2)": world(turn=2),
    "turned, x 1e-6, moved by 10 (1e7 units)": world(1e-6, (10, 0, -10), 3),
    "turned, x 1e9, moved by 1e16 (1e7 units)": world(1e9, (1e16, 1e16, 0), 4),
}  # fmt: skip


def encode(parts: Assembly, source: FrameSource) -> tuple[dict[str, float], str]:
    """Encode a recording: means of its quality and bytes, and a hash of all that its packets change."""
    held_out = HeldOut(parts.renderer, parts.recipe.background)
    encoder = Encoder(
        parts, source.info, lambda frame: gather_points(source.points, frame, parts.recipe.first_frame, encoder.rng)
    )
    lines, digest = [], hashlib.sha256()
    for index in range(min(parts.recipe.frames or 1 << 30, source.info.num_frames or 1 << 30)):
        step = encoder.encode(source.frame(index))
        for name in ATTRIBUTES:
            values = getattr(step.state.player.gaussians, name)
            digest.update(np.ascontiguousarray(values).tobytes())
        test = held_out.measure(step.state, encoder.with_near_plane(source.frame(index, "test")))
        line = {name: next(iter(test[name].values())) for name in ("psnr", "psnr_moving")}
        lines.append({**line, "kb": len(step.packet.data) / 1000})
    found = {"psnr_0": lines[0]["psnr"], "key_kb": lines[0]["kb"]}
    for name in ("psnr", "psnr_moving", "kb"):
        values = [line[name] for line in lines[1:] if line[name] is not None]
        found[name] = float(np.mean(values)) if values else float("nan")
    return found, digest.hexdigest()[:8]


def main(arguments: Sequence[str] | None = None) -> int:
    """Run as a command; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", default="demo")
    parser.add_argument("--method", default="s2gs-fast")
    parser.add_argument("--recipe", type=Path, action="append", default=[])
    parser.add_argument("--set", action="append", default=[], dest="sets", metavar="KEY=VALUE")
    parser.add_argument("--rows", nargs="*", choices=[*ROWS], default=[*ROWS])
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2])
    parser.add_argument("--as-filed", action="store_true")
    given = parser.parse_args(arguments)
    catalog = load_catalog()
    print("| world | PSNR 0 | PSNR | moving | key KB | KB/frame | scene |\n|---|--:|--:|--:|--:|--:|---|", flush=True)
    cases = [(f"as it is, seed {seed}", IDENTITY, seed) for seed in given.seeds]
    for name, where, seed in cases + [(name, ROWS[name], 0) for name in given.rows]:
        sets = [("--set", text) for text in (*given.sets, f"seed={seed}")]
        parts = assemble(resolve_recipe(given.method, catalog.recipe_path, given.recipe, sets), catalog)
        moved = Moved(open_source(given.source, parts.recipe.scale), where)
        own = IDENTITY if given.to_file_coordinates else recording_similarity(moved)
        source = CanonicalSource(transformed(moved, parts.recipe.data), own)
        found, digest = encode(parts, source)
        numbers = [f"{found[key]:.2f}" for key in ("psnr_0", "psnr", "psnr_moving", "key_kb", "kb")]
        print(f"| {name} | {' | '.join(numbers)} | `{digest}` |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
