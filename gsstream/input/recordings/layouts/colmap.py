"""A COLMAP model of frame 0 with the frames of its cameras: sparse/0/ beside images/, or beside videos.

The model's images are the cameras. A camera is named after its image's own folder (``cam00/000000.png`` -> cam00) when
every image has one, else after the image (``cam00.png`` -> cam00). Its frames are the first of these that is there:
``images/NAME/*.png``, ``frames/NAME/*.png``, ``videos/NAME.mp4``, ``images/NAME.mp4``, ``NAME.mp4``, and else the image
alone: a still scene of one frame. There are no test cameras unless ``data.test_cameras`` says so.
"""

from __future__ import annotations

from pathlib import Path, PurePosixPath

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.errors import SourceError
from gsstream.core.frame import PointCloud
from gsstream.core.shapes import FloatArray
from gsstream.input.recordings.clips import VIDEO_SUFFIXES, Clip, ImageClip, folder_clip, images_in
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

_PLACES = ("sparse/0", "sparse", ".")


def looks_like(folder: Path) -> bool:
    """Say whether cameras and images (.bin or .txt) lie in sparse/0/ or sparse/."""
    return any(has_model(folder / place) for place in _PLACES)


def read(folder: Path) -> Recording:
    """Read a COLMAP model; cameras with distortion are undistorted on reading.

    A point counts as seen by the images of its track.
    """
    model = next((folder / place for place in _PLACES if has_model(folder / place)), None)
    if model is None:
        raise SourceError(f"{folder}: no COLMAP model; expected cameras and images (.bin or .txt) in sparse/0/")
    cameras, images = read_cameras(model), read_images(model)
    if not images:
        raise SourceError(f"{model}: the model has no registered images")
    numbers = sorted(images, key=lambda number: images[number].name)
    names = _names(model, [images[number].name for number in numbers])
    poses, Ks, lenses, sizes = [], [], {}, {}
    for name, number in zip(names, numbers, strict=True):
        image = images[number]
        if image.camera not in cameras:
            raise SourceError(f"{model}: image {image.name!r} uses camera {image.camera}, which is not in the model")
        camera = cameras[image.camera]
        poses.append(from_quaternion(_unit(model, image), image.translation))
        K, lens = from_colmap(camera.model, camera.params, f"{model}: camera {image.camera}")
        Ks.append(K)
        sizes[name] = (camera.width, camera.height)
        if not lens.is_identity:
            lenses[name] = lens
    rig = Cameras(tuple(names), np.stack(poses), np.stack(Ks), *sizes[names[0]])
    clips = {name: _clip(folder, name, images[number].name) for name, number in zip(names, numbers, strict=True)}
    return Recording(
        name=folder.resolve().name,
        where=str(model),
        rig=rig,
        clips=clips,
        lenses=lenses,
        sizes=sizes,
        points=lambda _: _points(model, numbers),
    )


def _unit(model: Path, image: ModelImage) -> FloatArray:
    norm = float(np.linalg.norm(image.quaternion))
    if not abs(norm - 1) < 1e-3:
        raise SourceError(f"{model}: image {image.name!r}: the quaternion has length {norm:g}, expected 1")
    return image.quaternion


def _names(model: Path, files: list[str]) -> list[str]:
    paths = [PurePosixPath(name) for name in files]
    if bad := [p for p in paths if p.is_absolute() or ".." in p.parts]:
        raise SourceError(f"{model}: image {str(bad[0])!r} must stay inside images/")
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


def _clip(folder: Path, name: str, image: str) -> Clip:
    for place in (folder / "images" / name, folder / "frames" / name):
        if images_in(place):
            return folder_clip(place)
    for stem in (folder / "videos" / name, folder / "images" / name, folder / name):
        for suffix in VIDEO_SUFFIXES:
            if (path := stem.with_name(stem.name + suffix)).is_file():
                from gsstream.input.recordings.video import VideoClip

                return VideoClip(path)
    path = folder / "images" / image
    if not path.is_file():
        raise SourceError(
            f"{folder}: no frames of camera {name!r}; expected images/{name}/, frames/{name}/, videos/{name}.mp4 or "
            f"images/{image}"
        )
    return ImageClip([path])


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
