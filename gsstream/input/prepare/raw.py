"""Raw recordings: a folder or a video per camera, or one photograph per camera; and those that a run reads, too."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsstream.core.errors import ShapeError, SourceError
from gsstream.core.install_hints import install_extra
from gsstream.core.names import check_camera_ids
from gsstream.core.shapes import FloatArray
from gsstream.input.recordings.clips import Clip
from gsstream.input.recordings.images import PICTURE_FORMATS, read_image, told_apart
from gsstream.input.recordings.video import upright

PICTURES = (".png", ".jpg", ".jpeg")
VIDEOS = (".mp4", ".mov", ".mkv", ".avi", ".webm", ".ts")


@dataclass(frozen=True, slots=True)
class RawCamera:
    """One camera: its pictures in order, its video, or what the reader of a layout made of them."""

    name: str  # its id
    files: tuple[Path, ...]  # pictures in order, or one video; none where there is a clip
    size: tuple[int, int]  # (width, height) of frame 0
    clip: Clip | None = None  # the pictures as a reader found them, of which those of ``span`` are taken
    span: range = range(0)

    @property
    def is_video(self) -> bool:
        return bool(self.files) and self.files[0].suffix.lower() in VIDEOS

    @property
    def copied(self) -> bool:
        """Whether its pictures are files that a scene may hold as they are."""
        return {path.suffix.lower() for path in self.files} in ({".png"}, {".jpg"})

    def frames(self, most: int | None) -> Iterator[FloatArray]:
        """Read the first ``most`` pictures [H, W, 3] in [0, 1]. Raises SourceError for one that cannot be read."""
        if self.clip is not None:
            yield from (self.clip.read(index, self.size) for index in self.span[:most])
            return
        if self.is_video:
            yield from _video_frames(self.files[0], most)
            return
        for path in self.files[:most]:
            yield read_image(path, self.size, self.size)


def find_cameras(folder: Path) -> list[RawCamera]:
    """Return the cameras of a raw recording, in order of their names.

    Recognised: one folder of pictures per camera; one video per camera; one picture per camera. Raises SourceError for
    anything else, and for fewer than two cameras.
    """
    if not folder.is_dir():
        raise SourceError(f"{folder}: no such folder; expected a raw recording")
    inside = sorted(p for p in folder.iterdir() if not p.name.startswith("."))
    folders = {p.name: _pictures(p) for p in inside if p.is_dir()}
    found = {name: files for name, files in folders.items() if files}
    if not found:
        videos: dict[str, tuple[Path, ...]] = {p.stem: (p,) for p in inside if p.suffix.lower() in VIDEOS}
        found = videos or {p.stem: (p,) for p in _pictures(folder)}
    if len(found) < 2:
        photographs = [*folder.glob("*.[hH][eE][iI][cCfF]"), *folder.glob("*/*.[hH][eE][iI][cCfF]")]
        if photographs:
            raise SourceError(f"{photographs[0]} and {len(photographs) - 1} more: {told_apart(photographs[0])}")
        raise SourceError(
            f"{folder}: cameras found: {len(found)}; expected at least two: a folder of pictures per camera, "
            f"a video per camera, or a picture per camera ({', '.join(PICTURES + VIDEOS)})"
        )
    try:
        check_camera_ids(found)
    except ShapeError as error:
        raise SourceError(f"{folder}: {error}") from error
    return [RawCamera(name, files, _size(files[0])) for name, files in found.items()]


def first_frames(cameras: list[RawCamera]) -> list[FloatArray]:
    """Return frame 0 of every camera."""
    return [next(camera.frames(1)) for camera in cameras]


def _pictures(folder: Path) -> tuple[Path, ...]:
    return tuple(sorted(p for p in folder.iterdir() if p.suffix.lower() in PICTURES and not p.name.startswith(".")))


def _size(path: Path) -> tuple[int, int]:
    if path.suffix.lower() in VIDEOS:
        height, width = next(_video_frames(path, 1)).shape[:2]
        return width, height
    from PIL import Image

    try:
        with Image.open(path, formats=PICTURE_FORMATS) as image:
            return image.size
    except (OSError, Image.DecompressionBombError) as error:
        cure = told_apart(path)
        raise SourceError(f"{path}: cannot be read as a picture ({error}); expected PNG or JPEG; {cure}") from error


def _video_frames(path: Path, most: int | None) -> Iterator[FloatArray]:
    try:
        import av
    except ImportError as error:
        raise SourceError(f"{path}: reading videos needs PyAV: {install_extra('video')}") from error
    count = 0
    try:
        with av.open(str(path)) as container:
            for frame in container.decode(video=0):
                if most is not None and count >= most:
                    return
                count += 1
                pixels = upright(frame.to_ndarray(format="rgb24"), frame.rotation, path)
                yield pixels.astype(np.float32) / np.float32(255)
    except av.FFmpegError as error:
        raise SourceError(f"{path}: the video cannot be decoded after {count} frames ({error})") from error
    if count == 0:
        raise SourceError(f"{path}: the video holds no frame")
