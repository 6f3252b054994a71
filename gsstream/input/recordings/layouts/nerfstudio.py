"""nerfstudio (and instant-ngp) transforms.json.

``frames``: a list of ``file_path`` and ``transform_matrix``, camera to world with OpenGL axes (x right, y up, z back).
Intrinsics ``fl_x fl_y cx cy w h`` and distortion once or per frame, or angles ``camera_angle_x``, ``camera_angle_y``
(radians) and ``x_fov``, ``y_fov`` (degrees); ``camera_model`` says which coefficients there are, ``is_fisheye`` that
they are a fisheye's. Pixels have their origin at the image corner, world units are whatever wrote the file.

One camera per entry: its ``file_path`` is a video, a folder of frames, or one image (a still scene of one frame).
Entries of one folder with equal poses are one camera's frames, in the order of ``time`` if given, else of their names;
in one flat folder those of equal pose and intrinsics are. Entries without a picture or a pose are skipped, with a
warning. ``test_filenames`` (and ``val_filenames``) are test cameras; without them there is none. Where there are
``train_filenames``, cameras of no list are left out. ``ply_file_path``: points, made from all images.

Blender's scenes have transforms_train.json, and transforms_val.json and transforms_test.json with the test cameras.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from typing import Any, Literal

import numpy as np

from gsstream.core.errors import SourceError, suggest
from gsstream.input.recordings.calibration import read_json
from gsstream.input.recordings.clips import IMAGE_SUFFIXES, VIDEO_SUFFIXES, Clip, folder_clip, listed_clips
from gsstream.input.recordings.foreign import Keys, check_keys, inside, left_out, number, parsed, warn
from gsstream.input.recordings.layouts.nerfstudio_camera import COEFFICIENTS, camera_of, pose_of
from gsstream.input.recordings.layouts.nerfstudio_groups import INTRINSICS, group_entries
from gsstream.input.recordings.pointfiles import read_ply_points
from gsstream.input.recordings.recorded import Recording, SeenPoints
from gsstream.input.recordings.rigs.camera import assembled_rig, say_unused
from gsstream.input.recordings.video import VideoClip

FILE, SPLIT_FILE = "transforms.json", "transforms_{}.json"
Missing = Literal["skip", "refuse"]
_SPLITS = ("train_filenames", "val_filenames", "test_filenames")
#: null counts as not given.
_OPTIONAL = ("w", "h", "fps", "time", "camera_model", "is_fisheye", "transform_matrix", "ply_file_path", *_SPLITS)
#: Keys that nerfstudio, instant-ngp and exporters for Blender write; those without an effect belong to training or to
#: masks.
_KEYS = Keys(
    read=" ".join((*INTRINSICS, *_SPLITS)) + " fps time frames file_path transform_matrix ply_file_path",
    idle="""
        applied_transform applied_scale orientation_override auto_scale_poses_override aabb_scale aabb scale
        offset from_na sharpness up n_images enable_depth_loading integer_depth_scale enable_ray_loading
        white_transparent black_transparent fix_premult light_dir render_aabb colmap_im_id colmap_image_id
        depth_file_path depth_unit_scale_factor mask_path normal_file_path semantics_file_path panoptic_classes
        rotation camera_id cam_id
    """,
    refused="""
        rolling_shutter latlong ftheta_* k7 k8 p3 p4 b1 b2 s1 s2 s3 s4 sk_x sx1 sx2 sy1 sy2 skew
        is_equirectangular distortion_params camera_convention coordinate_system is_ortho ortho_scale shift_x
        shift_y
    """,
)


def looks_like(folder: Path) -> bool:
    """Say whether there is a transforms.json, or one of Blender's per split."""
    return (folder / FILE).is_file() or (folder / SPLIT_FILE.format("train")).is_file()


def read(folder: Path, missing: Missing = "skip") -> Recording:
    """Read one rig of cameras that stand still.

    Raises SourceError for a camera that moves, and for what is not as expected.
    """
    path, data = _load(folder)
    files = _files(folder, data["frames"])
    there = _present(path, data["frames"], files, missing)
    split = path.name != FILE and not any("time" in entry for entry in there)
    groups = {_name(entry): [entry] for entry in there} if split else group_entries(path, there, pose_of)
    if len(there) < len(data["frames"]) and any(len(g) > 1 and "time" not in g[0] for g in groups.values()):
        raise SourceError(
            f"{path}: pictures of a recording are missing, and no 'time' says which instants are left: the cameras "
            "would be shifted against each other. Restore them, or give every entry its 'time'"
        )
    groups, test = _split(path, data, groups)
    clips = _clips({name: [files[entry["file_path"]] for entry in entries] for name, entries in groups.items()})
    say_unused(path, clips, list(files.values()))
    cameras = {
        name: camera_of(path, {**data, **entries[0]}, name, clips[name].size) for name, entries in groups.items()
    }
    points = data.get("ply_file_path")
    if points is not None and not (isinstance(points, str) and (folder / points).is_file()):
        warn(f"{path}: ply_file_path {points!r} is no file of the folder; the recording has no points")
        points = None
    return assembled_rig(
        folder,
        path,
        cameras,
        clips,
        test=test,
        points=lambda _: _points(folder, points, len(groups)),
        fps=number(str(path), "fps", data.get("fps", 30.0), above=0, below=1e6),
    )


def _load(folder: Path) -> tuple[Path, dict[str, Any]]:
    """What transforms.json holds, else what the files of Blender's splits do: the test cameras are those of two."""
    if not (folder / SPLIT_FILE.format("train")).is_file() or (folder / FILE).is_file():
        return folder / FILE, _load_one(folder / FILE)
    whole: dict[str, Any] = {"frames": []}
    for split, names in zip(("train", "val", "test"), _SPLITS, strict=True):
        if (path := folder / SPLIT_FILE.format(split)).is_file():
            part = _load_one(path)
            shared = {key: part.pop(key) for key in INTRINSICS if key in part}
            frames = [shared | entry for entry in part.pop("frames")]
            whole = part | whole | {"frames": whole["frames"] + frames, names: [f["file_path"] for f in frames]}
    return folder / SPLIT_FILE.format("train"), whole


def _name(entry: dict[str, Any]) -> str:
    return str(PurePosixPath(entry["file_path"]).with_suffix("")).replace("/", "_")


def _load_one(path: Path) -> dict[str, Any]:
    known = read_json(path)
    frames = known.get("frames")
    if not isinstance(frames, list) or not frames or not all(isinstance(f, dict) for f in frames):
        raise SourceError(f"{path}: 'frames' must be a non-empty list of objects")
    known, *frames = [
        {key: value for key, value in entry.items() if value is not None or key not in _OPTIONAL}
        for entry in (known, *frames)
    ]
    for entry in (known, *frames):  # its converter of RealityCapture's tables writes coefficients as texts
        for key in COEFFICIENTS:
            if isinstance(value := entry.get(key), str):
                entry[key] = float(parsed(str(path), key, [value], 1)[0])
    for place, entry in enumerate(frames):
        name = entry.get("file_path")
        if not isinstance(name, str) or not name:
            raise SourceError(f"{path}: frame {place} has no 'file_path'")
        entry["file_path"] = inside(f"{path}: file_path", name)
        if "time" in entry:
            number(str(path), f"time of {name!r}", entry["time"])
    check_keys(str(path), (known, *frames), _KEYS)
    return {**known, "frames": frames}


def _present(
    path: Path, frames: list[dict[str, Any]], files: dict[str, Path], missing: Missing
) -> list[dict[str, Any]]:
    """The entries whose pose and picture, video or folder are there; nerfstudio itself passes over the others, too."""
    blind = [entry for entry in frames if not files[entry["file_path"]].exists()]
    lost = [entry for entry in frames if "transform_matrix" not in entry]
    kept = [entry for entry in frames if "transform_matrix" in entry and files[entry["file_path"]].exists()]
    for bad, why in ((blind, "pictures are missing"), (lost, "entries have no transform_matrix")):
        if not bad:
            continue
        message = f"{path}: {len(bad)} of {len(frames)} {why}, the first is {bad[0]['file_path']}"
        if not kept or missing == "refuse":
            raise SourceError(f"{message}; restore them, or take them out of the file")
        warn(
            f"{message}; they are skipped, as nerfstudio does, and {len(kept)} stay. To refuse them: --source "
            f"'nerfstudio:{path.parent}?missing=refuse'"
        )
    return kept


def _split(
    path: Path, data: dict[str, Any], groups: dict[str, list[dict[str, Any]]]
) -> tuple[dict[str, list[dict[str, Any]]], tuple[str, ...]]:
    """The cameras that the lists of names leave, and those of them that are held out."""
    train, val, test = (_listed(path, data, key) for key in _SPLITS)
    held = (val or set()) | (test or set())
    named = {name: {entry["file_path"] for entry in entries} for name, entries in groups.items()}
    if train is None:
        return groups, tuple(name for name, files in named.items() if files & held)
    if both := [name for name, files in named.items() if files & held and files & train]:
        raise SourceError(
            f"{path}: camera {both[0]!r} is in train_filenames and in a list of pictures that are held out"
        )
    kept = {name: groups[name] for name, files in named.items() if files & (held | train)}
    left_out(str(path), "that no list of file names holds", [n for n in groups if n not in kept], len(kept))
    return kept, tuple(name for name in kept if named[name] & held)


def _listed(path: Path, data: dict[str, Any], key: str) -> set[str] | None:
    """The entries that a list names; None where there is no such list."""
    names = data.get(key)
    if names is None:
        return None
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise SourceError(f"{path}: {key} must be a list of file names, got {names!r:.60}")
    files = [entry["file_path"] for entry in data["frames"]]
    # Names are compared loosely: upper and lower case and a suffix make no difference.
    known = {_loose(name): name for name in files} | {name: name for name in files}
    plain = {name: inside(f"{path}: {key}", name) for name in names}
    found = {name: known.get(file, known.get(_loose(file))) for name, file in plain.items()}
    if unknown := [name for name, entry in found.items() if entry is None]:
        raise SourceError(
            f"{path}: {key}: {unknown[0]!r} is no file_path of an entry{suggest(unknown[0], files[:100])}"
        )
    return {name for name in found.values() if name is not None}


def _loose(name: str) -> str:
    suffix = PurePosixPath(name).suffix
    return (name.removesuffix(suffix) if suffix.lower() in IMAGE_SUFFIXES else name).casefold()


def _files(folder: Path, frames: list[dict[str, Any]]) -> dict[str, Path]:
    """The file or folder of each file_path; Blender's scenes leave the suffix out, and some systems take any case."""
    found: dict[str, Path] = {}
    listed: dict[Path, dict[str, Path]] = {}
    for name in (entry["file_path"] for entry in frames):
        found[name] = file = folder / name
        if file.exists() or not file.parent.is_dir():
            continue
        if file.parent not in listed:
            inside = sorted(file.parent.iterdir(), reverse=True)
            exact = {other.name.casefold(): other for other in inside}
            listed[file.parent] = {_loose(other.name): other for other in inside} | exact
        # A name with the suffix of a picture means no picture of another format.
        key = file.name.casefold()
        found[name] = listed[file.parent].get(key if file.suffix.lower() in IMAGE_SUFFIXES else _loose(key), file)
    return found


def _clips(groups: dict[str, list[Path]]) -> dict[str, Clip]:
    """Every camera's pictures: those that entries name one by one, a folder of them, or a video."""
    whole: dict[str, Clip] = {
        name: folder_clip(file) if file.is_dir() else VideoClip(file)
        for name, (file, *others) in groups.items()
        if not others and (file.is_dir() or file.suffix.lower() in VIDEO_SUFFIXES)
    }
    listed = listed_clips({name: own for name, own in groups.items() if name not in whole})
    return {name: (whole | listed)[name] for name in groups}


def _points(folder: Path, name: str | None, cameras: int) -> SeenPoints | None:
    if name is None:
        return None
    cloud = read_ply_points(folder / name)
    return SeenPoints(cloud, np.ones((len(cloud), cameras), bool))
