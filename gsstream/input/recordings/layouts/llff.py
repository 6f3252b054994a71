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

from gsstream.core.cameras import Cameras
from gsstream.core.errors import SourceError
from gsstream.core.shapes import FloatArray
from gsstream.input.recordings.clips import VIDEO_SUFFIXES, Clip, ImageClip, folder_clip, images_in, natural_sort_key
from gsstream.input.recordings.poses import from_llff
from gsstream.input.recordings.recorded import Recording

POSES_FILE = "poses_bounds.npy"
#: Pictures may be scaled, not cropped or squeezed.
_ASPECT_TOLERANCE = 0.01


def looks_like_llff(folder: Path, pattern: str) -> bool:
    """Say whether there is a poses_bounds.npy beside videos, folders or pictures of instants called so (a glob)."""
    return (folder / POSES_FILE).is_file() and any(any(folder.glob(named)) for named in (pattern, f"frame*1/{pattern}"))


def read_llff(folder: Path, pattern: str) -> Recording:
    """Read a recording whose cameras are called so; the first of them is for tests."""
    clips = _camera_clips(folder, pattern)
    names = tuple(clips)
    rig = read_poses_bounds(folder / POSES_FILE, names, clips[names[0]].size)
    return Recording(
        name=folder.resolve().name,
        where=str(folder / POSES_FILE),
        rig=rig,
        clips=clips,
        test=names[:1],
        licence="see the data set",
    )


def _camera_clips(folder: Path, pattern: str) -> dict[str, Clip]:
    """Return camera id -> clip, in natural order, from the first of these layouts that is there.

    ``NAME.mp4``; ``NAME/images/*.png``; ``NAME/*.png``; ``frame000001/NAME.png``. NAME follows ``pattern`` (a glob).
    """
    videos = [p for p in folder.glob(pattern) if p.suffix.lower() in VIDEO_SUFFIXES]
    if videos:
        from gsstream.input.recordings.video import VideoClip

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
    first = [p for p in images_in(instants[0]) if p.match(f"{pattern}.*")]
    if not first:
        raise SourceError(f"{instants[0]}: no pictures {pattern}.png; expected one per camera")
    clips: dict[str, Clip] = {}
    for picture in first:
        clips[picture.stem] = ImageClip([instant / picture.name for instant in instants])
    return clips


def read_poses_bounds(path: Path, names: Sequence[str], size: tuple[int, int]) -> Cameras:
    """Return the rig of poses_bounds.npy for pictures of ``size`` (width, height).

    Raises SourceError when the file is not such an array, has another number of rows than there are cameras, or was
    made for pictures of another shape.
    """
    rows = _load(path)
    if len(rows) != len(names):
        raise SourceError(
            f"{path}: {len(rows)} rows for {len(names)} cameras ({', '.join(names)}); rows belong to the cameras in "
            "natural order of their names: restore the missing cameras, or delete the rows of those left out"
        )
    matrices = rows[:, :15].reshape(-1, 3, 5)
    heights, widths, focals = matrices[:, 0, 4], matrices[:, 1, 4], matrices[:, 2, 4]
    for name, height, width, focal in zip(names, heights, widths, focals, strict=True):
        if not (height > 0 and width > 0 and focal > 0):
            raise SourceError(
                f"{path}: camera {name!r}: expected positive height, width and focal length, got {height:g}, "
                f"{width:g}, {focal:g}; is this the LLFF format?"
            )
        if abs(width / height * size[1] / size[0] - 1) > _ASPECT_TOLERANCE:
            raise SourceError(
                f"{path}: camera {name!r} is calibrated for {width:g} x {height:g}, but the pictures are "
                f"{size[0]} x {size[1]}, another shape; use pictures that are scaled, not cropped"
            )
    Ks: FloatArray = np.tile(np.eye(3), (len(rows), 1, 1))
    Ks[:, 0, 0] = Ks[:, 1, 1] = focals * size[0] / widths
    Ks[:, 0, 2], Ks[:, 1, 2] = size[0] / 2, size[1] / 2
    return Cameras(tuple(names), from_llff(matrices[:, :, :4]), Ks, *size)


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
