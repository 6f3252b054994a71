"""Video files through PyAV, by exact frame number: B-frames, variable rates, any order of access."""

from __future__ import annotations

import bisect
import threading
from fractions import Fraction
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from gsstream.core.errors import SourceError
from gsstream.core.install_hints import install_extra
from gsstream.input.recordings.images import shrink


class VideoClip:
    """The first ``frames`` pictures of a video, in the order of display. Opening reads all packet headers.

    Reading in order decodes each picture once; other orders seek to the key frame before. Colour range and matrix, more
    than 8 bits per channel and the rotation that the file states are honoured. Raises SourceError for a file that
    cannot be read or has no time stamps or fewer pictures.
    """

    def __init__(self, path: Path, frames: int | None = None) -> None:
        self._path = path
        self._av = _load_av(path)
        self._lock = threading.Lock()
        self._container: Any = None
        self._frames: Any = None
        self._next = 0
        with self._guard("opened"), self._av.open(str(path)) as container:
            self._check_stream(container)
            stream = container.streams.video[0]
            self._base: Fraction = stream.time_base
            table = [(p.pts, p.dts, p.is_keyframe) for p in container.demux(stream) if p.size and not p.is_discard]
            context = stream.codec_context
            # A file cut right behind its header has a stream, but nothing to learn the kind of pictures from.
            if not table or context.format is None:
                raise SourceError(f"{path}: the video holds no pictures; record or copy it again")
            self._stored = (context.width, context.height)
            self._deep = any(component.bits > 8 for component in context.format.components)
        if any(pts is None for pts, _, _ in table):
            raise SourceError(
                f"{path}: pictures without time stamps; put the stream into a container: ffmpeg -i IN -c copy OUT.mp4"
            )
        with self._guard("opened"), self._av.open(str(path)) as container:
            # Only a decoded picture says how the file wants to be turned.
            first = next(container.decode(video=0), None)
        self._rotation = 0 if first is None else int(first.rotation)
        self._size = self._stored if _quarters(path, self._rotation) % 2 == 0 else self._stored[::-1]
        self._pts = sorted(pts for pts, _, _ in table)[:frames]
        if frames is not None and len(self._pts) < frames:
            raise SourceError(
                f"{path}: {frames} frames are declared, the video holds {len(self._pts)}: lower 'frames', or leave it "
                "out where all cameras are videos"
            )
        self._keys = sorted((pts, pts if dts is None else dts) for pts, dts, key in table if key)

    @property
    def where(self) -> str:
        return str(self._path)

    @property
    def size(self) -> tuple[int, int]:
        return self._size

    @property
    def num_frames(self) -> int:
        return len(self._pts)

    @property
    def first(self) -> int:
        return 0

    @property
    def fps(self) -> float:
        """Frames per second, from the median distance of time stamps; 30 for a single picture."""
        if len(self._pts) < 2:
            return 30.0
        # Coarse clocks give 29.97 fps steps of 33 and 34 ticks: the mean of the ordinary ones is exact.
        steps = np.diff(np.array(self._pts, np.float64))
        ordinary = steps[np.abs(steps - median(steps)) <= 1.5]
        return float(1 / (ordinary.mean() * float(self._base)))

    @property
    def start_seconds(self) -> float:
        """Time stamp of the first picture."""
        return float(self._pts[0] * self._base)

    @property
    def largest_gap(self) -> tuple[int, float]:
        """(frame, frames) where time stamps are farthest from an even rate, and by how much."""
        ticks = np.array(self._pts, np.float64) - self._pts[0]
        off = ticks * float(self._base) * self.fps - np.arange(len(ticks))
        worst = int(np.abs(off).argmax())
        first = int(np.flatnonzero(np.abs(off) >= 0.5 * abs(off[worst]))[0]) if off[worst] else 0
        return first, float(off[worst])

    @property
    def deep(self) -> bool:
        return self._deep

    def read(self, index: int, target: tuple[int, int]) -> Any:
        """Decode one picture. Raises SourceError naming file and frame when the data is damaged."""
        with self._lock, self._guard(f"decoded at frame {index}"):
            try:
                pixels = self._decode(index)
            except BaseException:
                self._drop()
                raise
        if target == self._size and not self._deep:
            return pixels
        return shrink(pixels, target) / np.float32(65535 if self._deep else 255)

    def close(self) -> None:
        with self._lock:
            self._drop()

    def _check_stream(self, container: Any) -> None:
        if not container.streams.video:
            raise SourceError(f"{self._path}: no picture stream in this file")
        stream = container.streams.video[0]
        if stream.codec_context is None or not stream.codec_context.width:
            raise SourceError(f"{self._path}: the picture stream cannot be decoded here; re-encode it as H.264")

    def _decode(self, index: int) -> np.ndarray[Any, Any]:
        wanted = self._pts[index]
        if self._container is None or index != self._next:
            self._seek(wanted)
        for frame in self._frames:
            if frame.pts == wanted:
                self._next = index + 1
                return self._pixels(frame, index)
            if frame.pts is not None and frame.pts > wanted:
                break
        raise SourceError(f"{self._path}: frame {index} cannot be decoded; the video is cut or damaged there")

    def _seek(self, wanted: int) -> None:
        """Place the decoder at a key frame at or before the wanted time stamp."""
        if self._container is None:
            self._container = self._av.open(str(self._path))
            context = self._container.streams.video[0].codec_context
            # One thread per file: a rig has tens of them. Damage is an error, not a picture patched up in silence.
            context.thread_count = 1
            context.options = {"err_detect": "explode"}
        stream = self._container.streams.video[0]
        place = bisect.bisect_right(self._keys, (wanted, 2**62)) - 1
        if place < 0:
            raise SourceError(f"{self._path}: no key frame before time stamp {wanted}; re-encode the video")
        self._container.seek(self._keys[place][1], stream=stream, backward=True, any_frame=False)
        self._frames = self._container.decode(stream)

    def _pixels(self, frame: Any, index: int) -> np.ndarray[Any, Any]:
        if frame.is_corrupt:
            raise SourceError(f"{self._path}: frame {index} is damaged; copy or record the video again")
        if (frame.width, frame.height) != self._stored or frame.rotation != self._rotation:
            raise SourceError(
                f"{self._path}: frame {index} is {frame.width} x {frame.height} turned by {frame.rotation} degrees, "
                f"the first was {self._stored[0]} x {self._stored[1]} turned by {self._rotation}; re-encode the video "
                "at one size"
            )
        pixels: np.ndarray[Any, Any] = frame.to_ndarray(format="rgb48le" if self._deep else "rgb24")
        return upright(pixels, self._rotation, self._path)

    def _drop(self) -> None:
        if self._container is not None:
            self._container.close()
        self._container = self._frames = None

    def _guard(self, doing: str) -> _AvErrors:
        return _AvErrors(self._path, doing, self._av)


def upright(pixels: np.ndarray[Any, Any], rotation: int, path: Path) -> np.ndarray[Any, Any]:
    """Turn [H, W, 3] pixels counterclockwise by what the file's display matrix says, degrees.

    Raises SourceError for an angle that is no multiple of 90.
    """
    quarters = _quarters(path, rotation)
    return pixels if quarters == 0 else np.ascontiguousarray(np.rot90(pixels, quarters))


def _quarters(path: Path, rotation: int) -> int:
    if rotation % 90:
        raise SourceError(
            f"{path}: the file says to turn its pictures by {rotation} degrees; expected a multiple of 90: re-encode it"
        )
    return rotation // 90 % 4


class _AvErrors:
    """Turns what PyAV raises into a SourceError naming the file."""

    def __init__(self, path: Path, doing: str, av: Any) -> None:
        self._path, self._doing, self._av = path, doing, av

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        if isinstance(error, self._av.error.FFmpegError):
            raise SourceError(
                f"{self._path}: the video cannot be {self._doing} ({error.strerror or error}); it is probably cut or "
                "damaged: copy or record it again"
            ) from error


def _load_av(path: Path) -> Any:
    try:
        import av
    except ImportError as error:
        raise SourceError(f"{path}: reading videos needs PyAV: {install_extra('video')}") from error
    return av
