"""ENeRF-Outdoor and other EasyMocap recordings: intri.yml, extri.yml, images/00/000000.jpg (or videos/00.mp4).

OpenCV file storage. ``names``: camera ids. intri.yml: ``K_00`` 3 x 3 in pixels with (0, 0) in the *centre* of the first
pixel (OpenCV's convention; half a pixel is added on reading), ``dist_00`` k1, k2, p1, p2, k3. extri.yml: ``Rot_00``
3 x 3 (or ``R_00``, a rotation vector) and ``T_00``: world to camera, OpenCV axes, usually metres.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.errors import SourceError
from gsstream.core.shapes import FloatArray
from gsstream.input.recordings.clips import VIDEO_SUFFIXES, Clip, folder_clip
from gsstream.input.recordings.lens import Lens
from gsstream.input.recordings.poses import from_pixel_centers, from_rotation_vector
from gsstream.input.recordings.recorded import Recording
from gsstream.input.recordings.rigs.opencv_yaml import load_storage
from gsstream.input.recordings.sync import RecordingWarning

INTRINSICS, EXTRINSICS = "intri.yml", "extri.yml"


def looks_like(folder: Path) -> bool:
    """Say whether there is an intri.yml beside an extri.yml."""
    return (folder / INTRINSICS).is_file() and (folder / EXTRINSICS).is_file()


def read(folder: Path) -> Recording:
    """Read ENeRF-Outdoor: 18 cameras, 1920 x 1080, 30 frames per second; the test camera is the first, 00 (paper)."""
    intri, extri = load_storage(folder / INTRINSICS), load_storage(folder / EXTRINSICS)
    names = intri.get("names")
    if not isinstance(names, list) or not names or not all(isinstance(n, str) for n in names):
        raise SourceError(f"{folder / INTRINSICS}: 'names' must list the cameras")
    clips = {n: clip for n in sorted(names) if (clip := _clip_of(folder, n)) is not None}
    if not clips:
        raise SourceError(f"{folder}: no pictures of any camera; expected images/NAME/000000.jpg or videos/NAME.mp4")
    if blind := sorted(set(names) - set(clips)):
        note = f"{folder / INTRINSICS}: cameras without pictures are left out: {', '.join(blind)}"
        warnings.warn(note, RecordingWarning, stacklevel=2)
    names = list(clips)
    poses, Ks, lenses = [], [], {}
    for name in names:
        Ks.append(from_pixel_centers(_matrix(folder / INTRINSICS, intri, f"K_{name}", (3, 3))))
        poses.append(_pose(folder / EXTRINSICS, extri, name))
        lens = _lens(folder / INTRINSICS, intri, name)
        if lens is not None and not lens.is_identity:
            lenses[name] = lens
    rig = Cameras(tuple(names), np.stack(poses), np.stack(Ks), *clips[names[0]].size)
    return Recording(
        name=folder.resolve().name,
        where=str(folder / INTRINSICS),
        rig=rig,
        clips=clips,
        test=(names[0],),
        lenses=lenses,
        sizes={name: clip.size for name, clip in clips.items()},
        licence="see the data set",
    )


def _clip_of(folder: Path, name: str) -> Clip | None:
    if (folder / "images" / name).is_dir():
        return folder_clip(folder / "images" / name)
    for suffix in VIDEO_SUFFIXES:
        if (path := folder / "videos" / f"{name}{suffix}").is_file():
            from gsstream.input.recordings.video import VideoClip

            return VideoClip(path)
    return None


def _matrix(path: Path, data: dict[str, Any], key: str, shape: tuple[int, ...]) -> FloatArray:
    entry = data.get(key)
    values = entry.get("data") if isinstance(entry, dict) else None
    if values is None:
        raise SourceError(f"{path}: no matrix {key!r}; every camera in 'names' needs one")
    try:
        matrix = np.array([float(v) for v in values])
    except (TypeError, ValueError) as error:
        raise SourceError(f"{path}: {key!r} holds something that is not a number ({error})") from error
    if matrix.size != np.prod(shape):
        raise SourceError(f"{path}: {key!r} must hold {int(np.prod(shape))} numbers, got {matrix.size}")
    return matrix.reshape(shape)


def _pose(path: Path, data: dict[str, Any], name: str) -> FloatArray:
    pose = np.eye(4)
    if f"Rot_{name}" in data:
        pose[:3, :3] = _matrix(path, data, f"Rot_{name}", (3, 3))
    else:
        pose[:3, :3] = from_rotation_vector(_matrix(path, data, f"R_{name}", (3,)))
    pose[:3, 3] = _matrix(path, data, f"T_{name}", (3,))
    return pose


def _lens(path: Path, data: dict[str, Any], name: str) -> Lens | None:
    for key in (f"dist_{name}", f"D_{name}"):
        entry = data.get(key)
        if isinstance(entry, dict):
            count = len(entry.get("data") or ())
            if count not in (4, 5):
                raise SourceError(f"{path}: {key!r} must hold k1, k2, p1, p2 and maybe k3, got {count} numbers")
            k1, k2, p1, p2, *k3 = _matrix(path, data, key, (count,)).tolist()
            return Lens("radial", (k1, k2, *k3), (p1, p2))
    return None
