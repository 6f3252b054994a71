"""Poses and lenses of raw cameras that a calibration states, in any layout, before anything is matched."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path

from gsstream.core.errors import InputError, SourceError
from gsstream.core.shapes import FloatArray
from gsstream.input.prepare.raw import RawCamera, beside_each_other, find_cameras
from gsstream.input.recordings.detect import LAYOUTS, layouts_of
from gsstream.input.recordings.lens import Lens
from gsstream.input.recordings.open import read_recording
from gsstream.input.recordings.recorded import checked_rig


@dataclass(frozen=True, slots=True)
class GivenRig:
    """A calibration: ``viewmats`` [C, 4, 4], ``Ks`` [C, 3, 3] and ``lenses``, for pixels of each camera's own pictures.

    ``test``: ids of the test cameras, which never train.
    """

    viewmats: FloatArray
    Ks: FloatArray
    lenses: tuple[Lens, ...]
    test: tuple[str, ...]
    licence: str

    def without(self, left_out: Collection[int]) -> GivenRig:
        """Return the calibration of the other cameras; ``left_out``: places in the rig."""
        kept = [i for i in range(len(self.lenses)) if i not in left_out]
        lenses = tuple(self.lenses[i] for i in kept)
        return replace(self, viewmats=self.viewmats[kept], Ks=self.Ks[kept], lenses=lenses)


@dataclass(frozen=True, slots=True)
class RawRecording:
    """What there is to prepare; ``fps``: frames per second as its calibration or its videos have it, if any."""

    title: str
    cameras: list[RawCamera]
    known: GivenRig | None
    fps: float | None

    def without(self, names: Collection[str]) -> RawRecording:
        """Return the recording without these cameras. Raises InputError for an unknown one."""
        there = [camera.name for camera in self.cameras]
        if unknown := sorted(set(names).difference(there)):
            raise InputError(f"--without: no camera {unknown[0]!r}; cameras: {', '.join(there)}")
        left_out = [i for i, name in enumerate(there) if name in names]
        cameras = [camera for camera in self.cameras if camera.name not in names]
        return replace(self, cameras=cameras, known=self.known and self.known.without(left_out))


def read_raw(source: str) -> RawRecording:
    """Read a recording that a run reads, or pictures or videos without a calibration.

    Raises SourceError for anything else.
    """
    folder = Path(source)
    if source.partition(":")[0] not in LAYOUTS and not (folder.is_dir() and layouts_of(folder)):
        cameras, fps = find_cameras(folder)
        return RawRecording(folder.resolve().name, cameras, None, fps)
    recording = read_recording(source)
    rig, (cameras, fps) = checked_rig(recording), beside_each_other(recording.name, recording.clips)
    if len(cameras) < 2:
        raise SourceError(f"{recording.where}: cameras found: {len(cameras)}; expected at least two")
    lenses = tuple(recording.lenses.get(name, Lens("radial", ())) for name in rig.ids)
    known = GivenRig(rig.viewmats, rig.Ks, lenses, recording.test, licence=recording.licence)
    title = recording.name if recording.folder is None else recording.folder.resolve().name
    return RawRecording(title, cameras, known, fps or recording.fps)
