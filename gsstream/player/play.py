"""Play a stream into pictures: a folder of PNGs, an animated WebP or GIF, or an MP4 (extra ``video``)."""

from __future__ import annotations

import importlib.util
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from gsstream.core.cameras import Cameras
from gsstream.core.errors import InputError, OutputError
from gsstream.core.install_hints import install_extra
from gsstream.core.memory import limited_memory
from gsstream.core.shapes import FloatArray
from gsstream.packet import StreamMeta
from gsstream.player.camera_file import read_path
from gsstream.player.interpolation import Moments, frame_times
from gsstream.player.paths import PATHS, camera_path, joined, resized
from gsstream.player.playback import Playback
from gsstream.player.region import recorded_region
from gsstream.player.render import PlayerRenderer, render, to_bytes

_ANIMATED = (".webp", ".gif")
#: File types that are written.
SUFFIXES = (".mp4", *_ANIMATED)
Bytes = np.ndarray[Any, np.dtype[np.uint8]]


@dataclass(frozen=True, slots=True)
class Played:
    """The file, or folder of PNGs, that was written, with ``frames`` pictures."""

    path: Path
    frames: int


def play(
    stream: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    camera: str | None = None,
    frames: Sequence[int] | None = None,
    fps: float | None = None,
    renderer: PlayerRenderer | None = None,
    progress: Callable[[int, int], None] | None = None,
    max_memory: int | None = None,
    size: tuple[int, int] | None = None,
) -> Played:
    """Render a stream from one camera.

    Raises InputError for an unknown camera or frame and beyond ``max_memory``, PacketError for a damaged stream
    (without ``frames``: once the pictures before the damage are written), OutputError when ``out`` cannot be written.
    """
    check_target(Path(out))
    with limited_memory(max_memory), Playback(stream) as playback:
        sound, damage = playback.sound() if frames is None else (frames, None)
        chosen = list(sound)
        if not chosen:
            raise InputError("no frames to play: expected at least one frame index")
        for frame in chosen:
            playback.entry(frame)
        rate = playback.meta.fps if fps is None else fps
        times = frame_times(chosen, playback.meta.fps, rate) if fps is not None else [float(frame) for frame in chosen]
        cameras, recorded = choose_cameras(playback, camera, len(times)), _recorded_focal(playback.meta, camera)
        cameras = cameras if size is None else resized(cameras, *size)
        kept = len(times) if Path(out).suffix.lower() in _ANIMATED else 1
        playback.limit.check_pictures(cameras.width, cameras.height, kept)
        images = _images(playback, times, cameras, recorded, renderer=renderer, progress=progress)
        try:
            played = write_pictures(Path(out), images, chosen if fps is None else range(len(times)), rate)
        except OSError as error:
            raise OutputError(f"cannot write {out}: {error.strerror or error}") from error
    if damage is not None:
        raise damage
    return played


def check_target(out: Path) -> None:
    """Refuse a file type that cannot be written here, and the folder of a run: it is no place for pictures.

    Raises OutputError.
    """
    suffix = out.suffix.lower()
    if out.is_dir():
        if (out / "stream.gss").exists():
            raise OutputError(f"{out} is the folder of a run; choose another for pictures, e.g. {out / 'pictures'}")
    elif suffix not in SUFFIXES and suffix[1:].isalnum() and not suffix[1:].isdigit():
        raise OutputError(
            f"{out}: {suffix} is not written; expected a file that ends with one of {', '.join(SUFFIXES)}, or a name "
            "without a suffix: a folder for PNGs"
        )
    elif suffix == ".mp4" and importlib.util.find_spec("av") is None:
        raise OutputError(
            f"{out}: writing MP4 needs PyAV, which is not installed: {install_extra('video')}. Without it, write "
            f"{out.with_suffix('.webp')}, a .gif, or a folder of PNGs"
        )


def choose_cameras(playback: Playback, camera: str | None, number: int) -> Cameras:
    """Return one camera for all pictures (by id), or ``number`` cameras along a path."""
    meta = playback.meta
    if camera in PATHS:
        rigs = [rig for rig in (meta.test, meta.train) if len(rig)]
        return camera_path(camera, rigs[-1], number, recorded_region(joined(rigs)))
    if camera is not None and camera.lower().endswith(".json") and camera not in (*meta.test.ids, *meta.train.ids):
        return read_path(Path(camera), meta.test if len(meta.test) else meta.train, number, meta.world)
    return meta.camera((*meta.test.ids, *meta.train.ids)[0] if camera is None else camera)


def _recorded_focal(meta: StreamMeta, camera: str | None) -> float:
    """Focal length, in pixels of the recording, of the camera that ``choose_cameras`` takes intrinsics from."""
    rig = (meta.test, meta.train)
    ids = [name for cameras in rig for name in cameras.ids]
    if camera in ids:
        return float(meta.camera(camera).Ks[0, 0, 0])
    used = [cameras for cameras in rig if len(cameras)][-1 if camera in PATHS else 0]
    return float(used.Ks[0, 0, 0])


def _images(
    playback: Playback,
    times: Sequence[float],
    cameras: Cameras,
    recorded: float,
    *,
    renderer: PlayerRenderer | None,
    progress: Callable[[int, int], None] | None,
) -> Iterator[Bytes]:
    scenes = Moments(playback)
    last: tuple[object, int, FloatArray] | None = None
    for i, time in enumerate(times):
        scene, view = scenes.at(time), min(i, len(cameras) - 1)
        # An empty packet keeps the very same scene object: nothing has to be rendered again.
        if last is None or last[0] is not scene or last[1] != view:
            scale = float(cameras.Ks[view, 0, 0]) / recorded
            behind = scenes.background
            last = (scene, view, render(scene, cameras, view, background=behind, renderer=renderer, scale=scale))
        yield to_bytes(last[2])
        if progress is not None:
            progress(i + 1, len(times))


def write_pictures(out: Path, images: Iterator[Bytes], frames: Sequence[int], fps: float) -> Played:
    """Write pictures as the suffix of a file says: a video, an animated picture, or a folder of PNGs."""
    suffix = out.suffix.lower()
    if suffix == ".mp4":
        return _write_video(out, images, fps)
    if suffix in _ANIMATED:
        return _write_animation(out, images, fps)
    out.mkdir(parents=True, exist_ok=True)
    count = 0
    for frame, image in zip(frames, images, strict=True):
        Image.fromarray(image).save(out / f"{frame:06d}.png", compress_level=3)
        count += 1
    return Played(out, count)


def _write_animation(out: Path, images: Iterator[Bytes], fps: float) -> Played:
    pictures = [Image.fromarray(image) for image in images]
    out.parent.mkdir(parents=True, exist_ok=True)
    options: dict[str, Any] = {"quality": 85} if out.suffix.lower() == ".webp" else {}
    pictures[0].save(
        out, save_all=True, append_images=pictures[1:], duration=max(1, round(1000 / fps)), loop=0, **options
    )
    return Played(out, len(pictures))


def _write_video(out: Path, images: Iterator[Bytes], fps: float) -> Played:
    import av

    out.parent.mkdir(parents=True, exist_ok=True)
    count = 0
    with av.open(str(out), "w") as container:
        stream: Any = None
        for image in images:
            # 4:2:0 needs even sides: the last row or column is repeated once where they are odd.
            image = np.pad(image, ((0, image.shape[0] % 2), (0, image.shape[1] % 2), (0, 0)), mode="edge")
            if stream is None:
                stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1001))
                stream.height, stream.width = image.shape[:2]
                stream.pix_fmt, stream.options = "yuv420p", {"crf": "16", "preset": "medium"}
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
            count += 1
        if stream is not None:
            container.mux(stream.encode())
    return Played(out, count)
