"""A COLMAP model of frame 0 with the frames of its cameras: sparse/0/ beside images/, or beside videos.

Where there are several models (sparse/0/, sparse/1/, ...), the one with the most images is read.

The model's images are the cameras. A camera is named after its image's own folder (``cam00/000000.png`` -> cam00) when
every image has one, else after the image (``cam00.png`` -> cam00). Its frames are the folder of pictures or
the video of that name in the first of ``images/``, ``frames/``, ``videos/`` and the folder itself that has one; else
they are the image alone, a still scene of one frame. There are no test cameras unless ``data.test_cameras`` says so.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath

import numpy as np

from gsstream.core.errors import SourceError
from gsstream.core.frame import PointCloud
from gsstream.core.shapes import FloatArray
from gsstream.input.recordings.clips import Clip, ImageClip, clip_at, natural_sort_key
from gsstream.input.recordings.foreign import inside, left_out, warn
from gsstream.input.recordings.layouts.colmap_model import (
    ModelImage,
    has_model,
    has_points,
    read_cameras,
    read_images,
    read_points,
)
from gsstream.input.recordings.lens import from_colmap
from gsstream.input.recordings.poses import from_quaternion
from gsstream.input.recordings.recorded import Recording, SeenPoints
from gsstream.input.recordings.rigs.camera import RigCamera, assembled_rig, say_unused


def looks_like(folder: Path) -> bool:
    """Say whether cameras and images (.bin or .txt) lie in sparse/NUMBER/ or sparse/."""
    return any(has_model(place) for place in _places(folder))


def _places(folder: Path) -> list[Path]:
    """Where a model may lie; a mapper that split leaves several beside each other."""
    inside = [p for p in (folder / "sparse").glob("*") if p.name.isdigit()]
    return [*sorted(inside, key=natural_sort_key), folder / "sparse", folder]


def read(folder: Path) -> Recording:
    """Read a COLMAP model, of several the one with the most images; cameras with distortion are undistorted on reading.

    A point counts as seen by the images of its track.
    """
    model, images = _largest(folder)
    cameras = read_cameras(model)
    numbers = sorted(images, key=lambda number: images[number].name)
    names = _names(model, [images[number].name for number in numbers])
    rig, clips = dict[str, RigCamera](), dict[str, Clip]()
    for name, number in zip(names, numbers, strict=True):
        image = images[number]
        if image.camera not in cameras:
            raise SourceError(f"{model}: image {image.name!r} uses camera {image.camera}, which is not in the model")
        camera = cameras[image.camera]
        K, lens = from_colmap(camera.model, camera.params, f"{model}: camera {image.camera}")
        pose = from_quaternion(_unit(model, image), image.translation)
        rig[name] = RigCamera(name=name, w2c=pose, K=K, lens=lens, size=(camera.width, camera.height), border=False)
        if (clip := _clip(folder, name, image.name)) is not None:
            clips[name] = clip
    left_out(str(model), "without pictures", [name for name in names if name not in clips], len(clips))
    say_unused(model, clips)
    kept = [number for name, number in zip(names, numbers, strict=True) if name in clips]
    return assembled_rig(folder, model, rig, clips, points=lambda _: _points(model, kept))


def _largest(folder: Path) -> tuple[Path, dict[int, ModelImage]]:
    """The model with the most images and those; a warning names the others."""
    models = {place: read_images(place) for place in _places(folder) if has_model(place)}
    if not models:
        raise SourceError(f"{folder}: no COLMAP model; expected cameras and images (.bin or .txt) in sparse/0/")
    best = max(models, key=lambda place: len(models[place]))
    if not models[best]:
        raise SourceError(f"{best}: the model has no registered images")
    if len(models) > 1:
        listed = ", ".join(f"{place.relative_to(folder)} has {len(images)} images" for place, images in models.items())
        warn(
            f"{folder}: several models: {listed}; {best.relative_to(folder)} is read: delete the others, or merge them"
        )
    return best, models[best]


def _unit(model: Path, image: ModelImage) -> FloatArray:
    norm = float(np.linalg.norm(image.quaternion))
    if not abs(norm - 1) < 1e-3:
        raise SourceError(f"{model}: image {image.name!r}: the quaternion has length {norm:g}, expected 1")
    return image.quaternion


def _names(model: Path, files: list[str]) -> list[str]:
    paths = [PurePosixPath(inside(f"{model}: image", name)) for name in files]
    folders, stems = [p.parent.name for p in paths], [p.stem for p in paths]
    if all(folders) and len(set(folders)) == len(paths):
        return folders
    if len(set(stems)) == len(paths):
        return stems
    twice = sorted({name for name in folders if folders.count(name) > 1 and name})
    raise SourceError(
        f"{model}: several images belong to one camera ({', '.join(twice) or 'equal names'}): a camera that moves, or "
        "several instants. Keep one image per camera in the model: frame 0"
    )


def _clip(folder: Path, name: str, image: str) -> Clip | None:
    for place in (folder / "images", folder / "frames", folder / "videos", folder):
        if (clip := clip_at(place / name)) is not None:
            return clip
    path = folder / "images" / inside(str(folder), image)
    return ImageClip([path]) if path.is_file() else None


def _points(model: Path, numbers: list[int]) -> SeenPoints | None:
    if not has_points(model):
        return None
    points = read_points(model)
    place = {number: column for column, number in enumerate(numbers)}
    seen = np.zeros((len(points.xyz), len(numbers)), bool)
    for row, track in enumerate(points.seen_by):
        seen[row, [place[int(number)] for number in track if int(number) in place]] = True
    cloud = PointCloud(
        points.xyz.astype(np.float64), points.rgb.astype(np.float32) / np.float32(255), f"COLMAP model {model.name}"
    )
    return SeenPoints(cloud, seen)
