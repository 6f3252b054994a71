"""Videos or pictures, and a calibration as other programs write it, recognised by what it holds.

The calibration lies in the folder itself, in ``calibration/`` or in ``images/``. Pictures: a video per camera, a folder
of pictures per camera, or one picture per camera, in the folder, in ``videos/`` or ``images/``, or in the one other
folder with videos. There are no test cameras unless ``data.test_cameras`` names some.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path

from gsstream.core.errors import SourceError
from gsstream.input.recordings.clips import VIDEO_SUFFIXES, Clip, clips_in, files_in, folders_in
from gsstream.input.recordings.foreign import left_out
from gsstream.input.recordings.recorded import Recording
from gsstream.input.recordings.rigs import metashape, opencv_yaml, qualisys, realitycapture, toml
from gsstream.input.recordings.rigs.camera import RigCamera, assembled_rig, matched
from gsstream.input.recordings.sync import RecordingWarning

READERS = (qualisys, toml, opencv_yaml, metashape, realitycapture)
PLACES = (".", "calibration", "images")
SUFFIXES = tuple({suffix for reader in READERS for suffix in reader.SUFFIXES})
#: Larger files are no calibration.
LARGEST = 1 << 24


def looks_like(folder: Path) -> bool:
    """Say whether a file holds a calibration of two cameras or more, or several files one camera each."""
    with warnings.catch_warnings():  # reading says it
        warnings.simplefilter("ignore", RecordingWarning)
        return any(sum(len(found) for _, found in files) > 1 for files in _found(folder))


def read(folder: Path) -> Recording:
    """Read poses and lenses, and find the pictures of their cameras; those that are only half there are left out."""
    rigs = [files for files in _found(folder) if sum(len(found) for _, found in files) > 1]
    if not rigs:
        raise SourceError(f"{folder}: no calibration of two cameras or more, here or in calibration/")
    if len(rigs) > 1:
        listed = ", ".join(str(files[0][0]) for files in rigs)
        raise SourceError(f"{folder}: several calibrations: {listed}; leave one of them there")
    path, first = rigs[0][0]
    # A file with a whole rig stands for itself; files of one camera each belong together.
    cameras = first if len(first) > 1 else [camera for _, found in rigs[0] for camera in found]
    known = {camera.name: camera for camera in cameras}
    if len(known) < len(cameras):
        raise SourceError(f"{path}: two cameras have one name: {', '.join(camera.name for camera in cameras)}")
    clips = _clips(folder)
    try:
        names = matched(tuple(known), tuple(clips))
    except SourceError as error:
        raise SourceError(f"{path}: {error}") from error
    left_out(str(path), "without pictures", [name for name in known if name not in names.values()], len(names))
    left_out(str(path), "without a calibration", [name for name in clips if name not in names], len(names))
    seen = {name: clip for name, clip in clips.items() if name in names}
    return assembled_rig(folder, path, {name: known[names[name]] for name in seen}, seen)


def _found(folder: Path) -> Iterator[list[tuple[Path, list[RigCamera]]]]:
    """For every format of which there are files: those files, in order of their names, and their cameras."""
    files = [path for place in PLACES for path in files_in(folder / place, SUFFIXES)]
    for reader in READERS:
        rig = [(path, reader.read(path, _text(path))) for path in files if path.suffix.lower() in reader.SUFFIXES]
        if rig := [(path, cameras) for path, cameras in rig if cameras]:
            yield rig


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8-sig") if path.is_file() and path.stat().st_size <= LARGEST else ""
    except (OSError, UnicodeDecodeError):
        return ""  # no text, so no calibration; nothing is said of files that are not asked for


def _clips(folder: Path) -> dict[str, Clip]:
    with_videos = [path for path in folders_in(folder) if len(files_in(path, VIDEO_SUFFIXES)) > 1]
    places = [folder, folder / "videos", folder / "images", *(with_videos if len(with_videos) == 1 else [])]
    if clips := clips_in(places):
        return clips
    raise SourceError(f"{folder}: no videos or pictures of two cameras or more, here, in videos/ or in images/")
