"""What is known of raw cameras before anything is matched: the poses and lenses of a calibration, in any layout."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from gsstream.core.errors import SourceError
from gsstream.core.shapes import FloatArray
from gsstream.input.prepare.raw import RawCamera, find_cameras
from gsstream.input.recordings.clips import Clip, ImageClip
from gsstream.input.recordings.detect import LAYOUTS, detect, layouts_of
from gsstream.input.recordings.layouts import declared
from gsstream.input.recordings.lens import Lens
from gsstream.input.recordings.open import read_layout
from gsstream.input.recordings.recorded import Recording, check_sizes
from gsstream.input.recordings.sync import align


@dataclass(frozen=True, slots=True)
class GivenRig:
    """A calibration: ``viewmats`` [C, 4, 4], ``Ks`` [C, 3, 3] and ``lenses``, for pixels of each camera's own pictures.

    ``test``: ids of the test cameras, which never train.
    """

    viewmats: FloatArray
    Ks: FloatArray
    lenses: tuple[Lens, ...]
    test: tuple[str, ...]
    fps: float
    licence: str


def read_raw(source: str) -> tuple[str, list[RawCamera], GivenRig | None]:
    """Return name, cameras and calibration, if any, of a recording that a run reads, or of pictures or videos.

    Raises SourceError for anything else.
    """
    scheme, colon, rest = source.partition(":")
    named = scheme if colon and scheme in LAYOUTS else None
    folder = Path(rest if named else source)
    if folder.is_dir() and named is None:
        named = detect(folder) if layouts_of(folder) else None
    if named is None:
        return folder.resolve().name, find_cameras(folder), None
    recording = declared.read(folder, any_sizes=True) if named == "folder" else read_layout(named, folder)
    return folder.resolve().name, *_taken(recording)


def _taken(recording: Recording) -> tuple[list[RawCamera], GivenRig]:
    check_sizes(recording)
    rig, beside = recording.rig, align(recording.name, recording.clips)
    cameras = [
        _camera(name, clip, range(beside.skip[name], beside.skip[name] + beside.num_frames))
        for name, clip in recording.clips.items()
    ]
    if len(cameras) < 2:
        raise SourceError(f"{recording.where}: cameras found: {len(cameras)}; expected at least two")
    lenses = tuple(recording.lenses.get(name, Lens("radial", ())) for name in rig.ids)
    fps = beside.fps or recording.fps
    return cameras, GivenRig(
        viewmats=rig.viewmats, Ks=rig.Ks, lenses=lenses, test=recording.test, fps=fps, licence=recording.licence
    )


def _camera(name: str, clip: Clip, span: range) -> RawCamera:
    """Pictures stay files, which a scene may hold as they are."""
    files = clip.files[span.start : span.stop] if isinstance(clip, ImageClip) else ()
    return (
        RawCamera(name, files, clip.size)
        if files
        else RawCamera(name=name, files=(), size=clip.size, clip=clip, span=span)
    )
