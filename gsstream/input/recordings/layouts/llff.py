"""poses_bounds.npy and its cameras, as N3DV and Meet Room ship them (the LLFF format).

One row of 17 numbers per camera, cameras in natural order of their names: a 3 x 5 matrix, row by row, then the nearest
and farthest depth (not used). Columns of the matrix: the camera's down, right and back axes in the world, its centre,
and (height, width, focal length in pixels). One focal length for both axes; the principal point is the image's middle.
Units are those of the structure from motion that made the file: not metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gsstream.core.errors import SourceError
from gsstream.core.shapes import FloatArray
from gsstream.input.recordings.clips import VIDEO_SUFFIXES, Clip, ImageClip, folder_clip, images_in, natural_sort_key
from gsstream.input.recordings.lens import Lens
from gsstream.input.recordings.poses import from_llff
from gsstream.input.recordings.recorded import Recording
from gsstream.input.recordings.rigs.camera import RigCamera, assembled_rig
from gsstream.input.recordings.video import VideoClip

POSES_FILE = "poses_bounds.npy"


def looks_like_llff(folder: Path, pattern: str) -> bool:
    """Say whether there is a poses_bounds.npy beside videos, folders or pictures of instants called so (a glob)."""
    return (folder / POSES_FILE).is_file() and any(any(folder.glob(named)) for named in (pattern, f"frame*1/{pattern}"))


def read_llff(folder: Path, pattern: str) -> Recording:
    """Read a recording whose cameras are called so; the first of them is for tests."""
    clips = _camera_clips(folder, pattern)
    cameras = read_poses_bounds(folder / POSES_FILE, list(clips))
    test = (next(iter(clips)),)
    return assembled_rig(folder, folder / POSES_FILE, cameras, clips, test=test, licence="see the data set")


def _camera_clips(folder: Path, pattern: str) -> dict[str, Clip]:
    """Return camera id -> clip, in natural order, from the first of these layouts that is there.

    ``NAME.mp4``; ``NAME/images/*.png``; ``NAME/*.png``; ``frame000001/NAME.png``. NAME follows ``pattern`` (a glob).
    """
    videos = [p for p in folder.glob(pattern) if p.suffix.lower() in VIDEO_SUFFIXES]
    if videos:
        return {p.stem: VideoClip(p) for p in sorted(videos, key=natural_sort_key)}
    folders = sorted((p for p in folder.glob(pattern) if p.is_dir()), key=natural_sort_key)
    if folders:
        return {p.name: folder_clip(p / "images" if (p / "images").is_dir() else p) for p in folders}
    instants = sorted((p for p in folder.glob("frame*") if p.is_dir()), key=natural_sort_key)
    if not instants:
        raise SourceError(
            f"{folder}: no videos {pattern}.mp4, no folders {pattern}/ and no folders frame000001/ with pictures"
        )
    return _by_instant(instants, pattern)


def _by_instant(instants: list[Path], pattern: str) -> dict[str, Clip]:
    there = [{path.stem: path for path in images_in(place)} for place in instants]
    first = [path for path in there[0].values() if path.match(f"{pattern}.*")]
    if not first:
        raise SourceError(f"{instants[0]}: no pictures {pattern}.png; expected one per camera")
    numbers = [int(digits) for place in instants if (digits := place.name.removeprefix("frame")).isdigit()]
    return {
        path.stem: ImageClip(
            [own.get(path.stem, place / path.name) for own, place in zip(there, instants, strict=True)],
            numbers if len(set(numbers)) == len(instants) else None,
        )
        for path in first
    }


def read_poses_bounds(path: Path, names: Sequence[str]) -> dict[str, RigCamera]:
    """Return the cameras of poses_bounds.npy, whose rows belong to these names.

    Raises SourceError when the file is not such an array, or has another number of rows than there are cameras.
    """
    rows = _load(path)
    if len(rows) != len(names):
        raise SourceError(
            f"{path}: {len(rows)} rows for {len(names)} cameras ({', '.join(names)}); rows belong to the cameras in "
            "natural order of their names: restore the missing cameras, or delete the rows of those left out"
        )
    matrices = rows[:, :15].reshape(-1, 3, 5)
    rig: dict[str, RigCamera] = {}
    for name, pose, (height, width, focal) in zip(names, from_llff(matrices[:, :, :4]), matrices[:, :, 4], strict=True):
        if not (height > 0 and width > 0 and focal > 0):
            raise SourceError(
                f"{path}: camera {name!r}: expected positive height, width and focal length, got {height:g}, "
                f"{width:g}, {focal:g}; is this the LLFF format?"
            )
        K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        size = (round(float(width)), round(float(height)))
        rig[name] = RigCamera(name=name, w2c=pose, K=K, lens=Lens("radial", ()), size=size, border=False)
    return rig


def _load(path: Path) -> FloatArray:
    try:
        rows = np.load(path, allow_pickle=False)
    except FileNotFoundError as error:
        raise SourceError(f"{path}: no such file; this layout keeps the cameras in {POSES_FILE}") from error
    except (OSError, ValueError, EOFError, MemoryError) as error:  # a header may announce any shape
        raise SourceError(f"{path}: cannot be read as a numpy array: {error}; download it again") from error
    if not isinstance(rows, np.ndarray) or rows.ndim != 2 or rows.shape[1] != 17 or rows.dtype.kind not in "fiu":
        got = f"{list(rows.shape)} {rows.dtype}" if isinstance(rows, np.ndarray) else type(rows).__name__
        raise SourceError(f"{path}: expected an array [cameras, 17] of numbers, got {got}")
    if not np.isfinite(rows).all():
        bad = int(np.flatnonzero(~np.isfinite(rows).all(1))[0])
        raise SourceError(f"{path}: row {bad} holds a value that is not finite")
    return rows.astype(np.float64)
