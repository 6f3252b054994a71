"""A recording in other coordinates: scaled, moved and turned as a whole, and what its encoding comes to."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gsstream.core.frame import Frame, PointCloud
from gsstream.core.gaussians import ATTRIBUTES
from gsstream.core.world import IDENTITY, World
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.frame0.points import gather_points
from gsstream.engine.run.encoder import Encoder
from gsstream.engine.run.measure import HeldOut
from gsstream.input.recordings.base import PointKind, Source, SourceInfo, Split, Wrapped


class Moved(Wrapped):
    """A recording whose calibration and points were written in another world: the same pictures.

    Arguments:
        source: an open recording.
        world: leads from its coordinates to the new ones.
    """

    def __init__(self, source: Source, world: World) -> None:
        super().__init__(source)
        self._world = world

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

    def stored_frame(self, index: int, split: Split = "train") -> Frame:
        """Read one instant as it is stored."""
        frame = self._source.stored_frame(index, split)
        return replace(frame, cameras=self._world.cameras(frame.cameras))


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


def encode(parts: Assembly, source: Source) -> tuple[dict[str, float], str]:
    """Encode a recording: means of its quality and bytes, and a hash of all that its packets change."""
    held_out = HeldOut(parts.renderer)
    encoder = Encoder(parts, source.info, lambda frame: gather_points(source, frame, parts.recipe.first_frame))
    lines, digest = [], hashlib.sha256()
    for index in range(min(parts.recipe.frames or 1 << 30, source.info.num_frames or 1 << 30)):
        step = encoder.encode(source.frame(index))
        for name in ATTRIBUTES:
            values = getattr(step.state.player.gaussians, name)
            digest.update(np.ascontiguousarray(values).tobytes())
        test = held_out.measure(step.state.player, encoder.with_near_plane(source.frame(index, "test")))
        line = {name: next(iter(test[name].values())) for name in ("psnr", "psnr_moving")}
        lines.append({**line, "kb": len(step.packet.data) / 1000})
    found = {"psnr_0": lines[0]["psnr"], "key_kb": lines[0]["kb"]}
    for name in ("psnr", "psnr_moving", "kb"):
        values = [line[name] for line in lines[1:] if line[name] is not None]
        found[name] = float(np.mean(values)) if values else float("nan")
    return found, digest.hexdigest()[:8]
