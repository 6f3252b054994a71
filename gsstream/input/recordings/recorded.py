"""A calibrated rig whose cameras are clips: what every reader of a layout returns."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.errors import ShapeError, SourceError
from gsstream.core.frame import PointCloud
from gsstream.core.names import check_camera_ids
from gsstream.core.shapes import BoolArray
from gsstream.core.storage import packed, to_bytes, unpacked
from gsstream.input.recordings.base import CameraSource, PointKind, SourceInfo, check_index
from gsstream.input.recordings.clips import Clip, prepare_command
from gsstream.input.recordings.depth_maps import FOLDER
from gsstream.input.recordings.images import scaled_size
from gsstream.input.recordings.lens import Lens, Undistortion, undistortion
from gsstream.input.recordings.sync import align


@dataclass(frozen=True, slots=True)
class SeenPoints:
    """Points and who took part in them: ``seen`` [P, C] bool over the cameras of the rig, in its order."""

    cloud: PointCloud
    seen: BoolArray


@dataclass(frozen=True, slots=True)
class Recording:
    """What a reader found on disk."""

    name: str  # short name
    where: str  # the calibration file, for messages
    rig: Cameras  # all cameras, world-to-camera, OpenCV axes, corner origin; ``Ks`` are those of the images as stored
    clips: Mapping[str, Clip]  # camera id -> its pictures, in the order of the rig
    test: tuple[str, ...] = ()  # ids of the test cameras, which never train
    fps: float = 30.0  # frames per second; videos know better
    lenses: Mapping[str, Lens] = field(default_factory=dict)  # camera id -> distortion, where there is any
    #: Camera id -> (width, height) of its pictures; empty: all have those of the rig.
    sizes: Mapping[str, tuple[int, int]] = field(default_factory=dict)
    #: Reads points of frame 0, the sparse ones where it has two kinds; None when none ship.
    points: Callable[[PointKind], SeenPoints | None] = lambda _: None
    licence: str = ""
    folder: Path | None = None  # the recording's, in which it may keep what else is known of frame 0


class RecordedSource(CameraSource):
    """Frames of a :class:`Recording`, area-averaged to ``scale``. Thread-safe.

    Cameras with distortion are resampled on reading, to the widest pinhole image without empty corners; ``info`` holds
    the intrinsics of what ``frame`` delivers. Raises SourceError when clips and calibration disagree.
    """

    def __init__(self, recording: Recording, *, scale: float = 1.0, uri: str) -> None:
        self._recording = recording
        if len(set(recording.sizes.values())) > 1:
            told = ", ".join(f"{name} {w} x {h}" for name, (w, h) in recording.sizes.items())
            raise SourceError(
                f"{recording.where}: all cameras of a rig must share one image size, got {told}; to bring pictures to "
                f"one size: {prepare_command(uri)}"
            )
        rig = checked_rig(recording)
        self._target = scaled_size((rig.width, rig.height), scale)
        self._alignment = align(recording.name, recording.clips)
        self._undistort: dict[str, Undistortion] = {}
        flat = self._flattened(rig)
        test = [i for i, name in enumerate(rig.ids) if name in recording.test]
        train = [i for i, name in enumerate(rig.ids) if name not in recording.test]
        if not train:
            raise SourceError(f"{recording.where}: there is no training camera among {', '.join(rig.ids)}")
        self._info = SourceInfo(
            name=recording.name,
            uri=uri,
            num_frames=self._alignment.num_frames,
            fps=self._alignment.fps or recording.fps,
            train=flat.select(train),
            test=flat.select(test),
            licence=recording.licence,
            depth_maps=None if recording.folder is None else recording.folder / FOLDER,
        )

    @property
    def info(self) -> SourceInfo:
        """What the recording says about itself; cameras at the size that ``frame`` delivers."""
        return self._info

    def stored_image(self, index: int, camera: str) -> Any:
        """Return one camera's image as it is stored; an undistorted one has the levels of the picture it is made of."""
        check_index(self._info, index)
        image = self._recording.clips[camera].read(index + self._alignment.skip[camera], self._target)
        if camera not in self._undistort:
            return packed(image)
        flat = self._undistort[camera].apply(unpacked(image))
        return to_bytes(flat) if image.dtype == np.uint8 else packed(flat)

    @property
    def stores_bytes(self) -> bool:
        """Whether pictures have 8 bits and are read at their size."""
        rig, clips = self._recording.rig, self._recording.clips.values()
        return self._target == (rig.width, rig.height) and not any(clip.deep for clip in clips)

    def points(self, kind: PointKind = "recording") -> PointCloud | None:
        """Return the points that ship, without those in which a test camera took part; None when none are left."""
        return self.points_without(self._info.test.ids, kind)

    def points_without(self, cameras: Sequence[str], kind: PointKind = "recording") -> PointCloud | None:
        """Return the points in which none of these cameras took part; None when none are left."""
        found = self._recording.points(kind)
        if found is None:
            return None
        barred = [i for i, name in enumerate(self._recording.rig.ids) if name in cameras]
        keep = ~found.seen[:, barred].any(1)
        if not keep.any():
            return None
        return replace(found.cloud, xyz=found.cloud.xyz[keep], rgb=found.cloud.rgb[keep])

    def close(self) -> None:
        """Close the clips."""
        for clip in self._recording.clips.values():
            clip.close()

    def _flattened(self, rig: Cameras) -> Cameras:
        """The rig of the pinhole images that are delivered."""
        Ks, flat = rig.Ks, rig.scaled(*self._target)
        pinholes = flat.Ks.copy()
        for i, name in enumerate(rig.ids):
            lens = self._recording.lenses.get(name)
            if lens is None or lens.is_identity:
                continue
            where = f"{self._recording.where}: camera {name!r}"
            made = undistortion(lens, Ks[i], (rig.width, rig.height), target=self._target, where=where)
            self._undistort[name], pinholes[i] = made, made.K
        return replace(flat, Ks=pinholes)


def checked_rig(recording: Recording) -> Cameras:
    """Return the rig, once its cameras are known to be sound and its clips to fit them. Raises SourceError."""
    rig = recording.rig
    try:
        check_camera_ids(rig.ids)
        rig.validate()
    except ShapeError as error:
        raise SourceError(f"{recording.where}: {error}") from error
    if not len(rig):
        raise SourceError(f"{recording.where}: no cameras")
    for name in recording.test:
        if name not in rig.ids:
            raise SourceError(f"{recording.where}: test camera {name!r} does not exist; cameras: {', '.join(rig.ids)}")
    for name, clip in recording.clips.items():
        width, height = recording.sizes.get(name, (rig.width, rig.height))
        if clip.size != (width, height):
            raise SourceError(
                f"{clip.where}: pictures of camera {name!r} are {clip.size[0]} x {clip.size[1]} pixels, but "
                f"{recording.where} is for {width} x {height}: correct the calibration, or restore the pictures"
            )
    return rig
