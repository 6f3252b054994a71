"""A recording in coordinates that its own cameras define, whatever those of its files are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.errors import SourceError
from gsstream.core.frame import Frame, PointCloud
from gsstream.core.world import World, rig_similarity, snap_cameras
from gsstream.input.recordings.base import PointKind, Source, SourceInfo, Split, Wrapped

#: Points farther from the rig than this many of its extents leave the range in which positions can be coded.
FARTHEST = 1e12


def recording_similarity(source: Source) -> World:
    """Return the world that a recording's cameras define, training and test cameras together.

    So the coordinates do not depend on the split.
    """
    train, test = source.info.train, source.info.test
    rig = train.joined(test)
    return rig_similarity(rig, source.points)


def to_file_coordinates(source: Source) -> Source:
    """Return a recording in the coordinates of its files, for checks of what the files say.

    Poses that were written the wrong way round are mended by inverting them in those coordinates, and in no others.
    """
    return source.filed if isinstance(source, CanonicalSource) else source


class CanonicalSource(Wrapped):
    """A source over another one: the same images, with cameras and points in canonical coordinates.

    ``info.world`` leads back. Thread-safe when the inner source is.
    """

    def __init__(self, source: Source, world: World) -> None:
        super().__init__(source)
        self._world, info = world, source.info
        self._info = replace(info, train=self._placed(info.train), test=self._placed(info.test), world=world)

    @property
    def info(self) -> SourceInfo:
        """The inner recording's, with cameras in this world."""
        return self._info

    @property
    def filed(self) -> Source:
        """The inner recording, in the coordinates of its files."""
        return self._source

    def frame(self, index: int, split: Split = "train") -> Frame:
        """Read one instant. Raises SourceError as the inner source does."""
        frame = self._source.frame(index, split)
        return replace(frame, cameras=self._placed(frame.cameras))

    def stored_frame(self, index: int, split: Split = "train") -> Frame:
        """Read one instant as it is stored."""
        frame = self._source.stored_frame(index, split)
        return replace(frame, cameras=self._placed(frame.cameras))

    def points(self, kind: PointKind = "recording") -> PointCloud | None:
        """Return the inner source's points in this world, float32. Raises SourceError for one that is absurdly far."""
        return self._placed_points(self._source.points(kind))

    def points_without(self, cameras: Sequence[str], kind: PointKind = "recording") -> PointCloud | None:
        """Return those of ``points`` in which none of these cameras took part; None when none are left."""
        return self._placed_points(self._source.points_without(cameras, kind))

    def _placed_points(self, cloud: PointCloud | None) -> PointCloud | None:
        if cloud is None:
            return None
        xyz = self._world.inverse_points(cloud.xyz)
        if len(xyz) and not float(np.abs(xyz).max()) < FARTHEST:
            raise SourceError(
                f"points of {self._info.name!r} ({cloud.origin}): expected positions within {FARTHEST:g} times the "
                f"size of the rig, got one at {float(np.abs(xyz).max()):g}; take it out of the file"
            )
        return replace(cloud, xyz=xyz.astype(np.float32))

    def _placed(self, rig: Cameras) -> Cameras:
        return snap_cameras(self._world.inverse_cameras(rig))
