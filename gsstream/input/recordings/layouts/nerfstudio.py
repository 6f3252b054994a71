"""nerfstudio (and instant-ngp) transforms.json.

``frames``: a list of ``file_path`` and ``transform_matrix``, camera to world with OpenGL axes (x right, y up, z back).
Intrinsics ``fl_x fl_y cx cy w h`` and distortion ``k1 k2 k3 k4 p1 p2`` once or per frame, or ``camera_angle_x`` alone;
``camera_model`` OPENCV (default), PINHOLE, SIMPLE_PINHOLE, OPENCV_FISHEYE. Pixels have their origin at the image
corner, world units are whatever wrote the file.

One camera per entry: its ``file_path`` is a video, a folder of frames, or one image (a still scene of one frame).
Entries of one folder with equal poses are one camera's frames, in the order of ``time`` if given, else of their names;
in one flat folder those of equal pose and intrinsics are. Entries without a picture are skipped, with a warning.
``test_filenames`` (and ``val_filenames``) are test cameras; without them there is none. ``ply_file_path``: points, made
from all images.
"""

from __future__ import annotations

import math
import warnings
from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.errors import SourceError
from gsstream.core.shapes import FloatArray
from gsstream.input.recordings.calibration import read_json
from gsstream.input.recordings.clips import VIDEO_SUFFIXES, Clip, ImageClip, folder_clip
from gsstream.input.recordings.layouts.nerfstudio_groups import group_entries
from gsstream.input.recordings.lens import Lens
from gsstream.input.recordings.pointfiles import read_ply_points
from gsstream.input.recordings.poses import from_opengl
from gsstream.input.recordings.recorded import Recording, SeenPoints
from gsstream.input.recordings.sync import RecordingWarning

FILE = "transforms.json"
Missing = Literal["skip", "refuse"]
_MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "OPENCV_FISHEYE")


def looks_like(folder: Path) -> bool:
    """Say whether there is a transforms.json."""
    return (folder / FILE).is_file()


def read(folder: Path, missing: Missing = "skip") -> Recording:
    """Read one rig of cameras that stand still.

    Raises SourceError for a camera that moves, and for what is not as expected.
    """
    path = folder / FILE
    data = _load(path)
    there = _present(folder, path, data["frames"], missing)
    groups = group_entries(path, there, _pose)
    if len(there) < len(data["frames"]) and any(len(g) > 1 and "time" not in g[0] for g in groups.values()):
        raise SourceError(
            f"{path}: pictures of a recording are missing, and no 'time' says which instants are left: the cameras "
            "would be shifted against each other. Restore them, or give every entry its 'time'"
        )
    poses, Ks, lenses, sizes = [], [], {}, {}
    clips: dict[str, Clip] = {}
    for name, entries in groups.items():
        clips[name] = _clip(folder, entries)
        merged = {**data, **entries[0]}
        poses.append(from_opengl(_pose(path, entries[0])))
        Ks.append(_intrinsics(path, merged, name, clips[name].size))
        sizes[name] = (int(merged.get("w", clips[name].size[0])), int(merged.get("h", clips[name].size[1])))
        lens = _lens(path, merged)
        if lens is not None and not lens.is_identity:
            lenses[name] = lens
    names = tuple(groups)
    held_out = {str(f) for key in ("test_filenames", "val_filenames") for f in data.get(key) or ()}
    test = tuple(name for name, entries in groups.items() if any(e["file_path"] in held_out for e in entries))
    return Recording(
        name=folder.resolve().name,
        where=str(path),
        rig=Cameras(names, np.stack(poses), np.stack(Ks), *sizes[names[0]]),
        clips=clips,
        test=test,
        fps=float(data.get("fps", 30.0)),
        lenses=lenses,
        sizes=sizes,
        points=lambda _: _points(folder, data, len(names)),
    )


def _load(path: Path) -> dict[str, Any]:
    known = read_json(path)
    frames = known.get("frames")
    if not isinstance(frames, list) or not frames or not all(isinstance(f, dict) for f in frames):
        raise SourceError(f"{path}: 'frames' must be a non-empty list of objects")
    for number, frame in enumerate(frames):
        name = frame.get("file_path")
        if not isinstance(name, str) or not name:
            raise SourceError(f"{path}: frame {number} has no 'file_path'")
        if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
            raise SourceError(f"{path}: file_path {name!r} must stay inside the folder")
    if known.get("camera_model", "OPENCV") not in _MODELS:
        raise SourceError(f"{path}: camera_model {known['camera_model']!r}; expected one of {', '.join(_MODELS)}")
    return known


def _present(folder: Path, path: Path, frames: list[dict[str, Any]], missing: Missing) -> list[dict[str, Any]]:
    """The entries whose picture, video or folder is there; nerfstudio itself passes over the others, too."""
    there = [entry for entry in frames if _file(folder, entry).exists()]
    if len(there) == len(frames):
        return there
    first = next(entry["file_path"] for entry in frames if not _file(folder, entry).exists())
    told = f"{path}: {len(frames) - len(there)} of {len(frames)} pictures are missing, the first is {first}"
    if not there or missing == "refuse":
        raise SourceError(f"{told}; restore them, or take them out of the file")
    warnings.warn(
        f"{told}; they are skipped, as nerfstudio does. To refuse them: --source 'nerfstudio:{folder}?missing=refuse'",
        RecordingWarning,
        stacklevel=2,
    )
    return there


def _file(folder: Path, entry: dict[str, Any]) -> Path:
    """The file or folder of an entry; Blender's scenes leave the suffix out."""
    file: Path = folder / entry["file_path"]
    return file if file.suffix or file.exists() else file.with_suffix(".png")


def _clip(folder: Path, entries: list[dict[str, Any]]) -> Clip:
    files = [_file(folder, entry) for entry in entries]
    if len(files) > 1:
        return ImageClip(files)
    if files[0].is_dir():
        return folder_clip(files[0])
    if files[0].suffix.lower() in VIDEO_SUFFIXES:
        from gsstream.input.recordings.video import VideoClip

        return VideoClip(files[0])
    return ImageClip(files)


def _pose(path: Path, entry: dict[str, Any]) -> FloatArray:
    name = entry["file_path"]
    try:
        pose = np.asarray(entry.get("transform_matrix"), np.float64)
    except (TypeError, ValueError) as error:
        raise SourceError(f"{path}: transform_matrix of {name!r} is not a matrix of numbers ({error})") from error
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise SourceError(f"{path}: transform_matrix of {name!r} must be a finite 4 x 4 matrix, got {list(pose.shape)}")
    return pose


def _number(path: Path, data: dict[str, Any], key: str, name: str) -> float:
    value = data[key]
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise SourceError(f"{path}: {key} of camera {name!r} must be a finite number, got {value!r}")
    return float(value)


def _intrinsics(path: Path, data: dict[str, Any], name: str, size: tuple[int, int]) -> FloatArray:
    width, height = data.get("w", size[0]), data.get("h", size[1])
    if "fl_x" in data:
        fx = _number(path, data, "fl_x", name)
        fy = _number(path, data, "fl_y", name) if "fl_y" in data else fx
    elif "camera_angle_x" in data:
        fx = fy = 0.5 * width / math.tan(0.5 * _number(path, data, "camera_angle_x", name))
    else:
        raise SourceError(f"{path}: camera {name!r} has neither fl_x nor camera_angle_x")
    cx = _number(path, data, "cx", name) if "cx" in data else width / 2
    cy = _number(path, data, "cy", name) if "cy" in data else height / 2
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def _lens(path: Path, data: dict[str, Any]) -> Lens | None:
    model = data.get("camera_model", "OPENCV")
    k = tuple(_number(path, data, key, data["file_path"]) if key in data else 0.0 for key in ("k1", "k2", "k3", "k4"))
    p = tuple(_number(path, data, key, data["file_path"]) if key in data else 0.0 for key in ("p1", "p2"))
    if model == "OPENCV_FISHEYE":
        return Lens("fisheye", k)
    if model != "OPENCV":
        return None
    if k[3]:
        raise SourceError(f"{path}: k4 = {k[3]:g} with camera_model OPENCV; is it an OPENCV_FISHEYE?")
    return Lens("radial", k[:3], (p[0], p[1]))


def _points(folder: Path, data: dict[str, Any], cameras: int) -> SeenPoints | None:
    name = data.get("ply_file_path")
    if not isinstance(name, str) or not (folder / name).is_file():
        return None
    cloud = read_ply_points(folder / name)
    return SeenPoints(cloud, np.ones((len(cloud), cameras), bool))
