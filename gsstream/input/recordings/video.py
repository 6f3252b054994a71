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
from gsstream.core.memory import require_memory
from gsstream.input.recordings.images import PER_AVERAGED, shrink

#: The four numbers of a display matrix that turn and mirror: a, b, c, d of :func:`display_matrix`.
Matrix = tuple[int, int, int, int]
_AS_STORED: Matrix = (1, 0, 0, 1)
#: Transfer curves of ITU-T H.273 whose values are no screen's.
_CURVES = {16: "PQ", 18: "HLG"}


class VideoClip:
    """The first ``frames`` pictures of a video, in the order of display. Opening reads all packet headers.

    Reading in order decodes each picture once; other orders seek to the key frame before. Colour range and matrix, more
    than 8 bits per channel, edit lists, and the turn or mirror image that the file asks for are honoured; cover
    pictures are passed over. Raises SourceError for a file that cannot be read or has no time stamps or fewer pictures.
    """

    def __init__(self, path: Path, frames: int | None = None) -> None:
        self._path, self.files, self.where = path, (path,), str(path)
        self._av = _load_av(path)
        self._lock = threading.Lock()
        self._container: Any = None
        self._frames: Any = None
        self._next = 0
        with self._guard("opened"), self._av.open(str(path)) as container:
            stream, others = self._film(container)
            self._stream, self._base = stream.index, Fraction(stream.time_base)
            self._stated: Fraction | None = stream.guessed_rate
            packets = [(p.pts, p.dts, p.is_keyframe, p.is_discard) for p in container.demux(stream) if p.size]
            # An edit list hides pictures, which are decoded all the same: the key frame in front of a cut is one.
            table = [packet for packet in packets if not packet[3]]
            context = stream.codec_context
            # A file cut right behind its header has a stream, but nothing to learn the kind of pictures from.
            if not table or context.format is None:
                raise SourceError(f"{path}: the video holds no pictures; record or copy it again")
            self._stored = (context.width, context.height)
            require_memory(context.width * context.height * PER_AVERAGED, f"a picture of {path}")
            self.deep = any(component.bits > 8 for component in context.format.components)
        if any(pts is None for pts, *_ in table):
            raise SourceError(
                f"{path}: pictures without time stamps; put the stream into a container: ffmpeg -i IN -c copy OUT.mp4"
            )
        with self._guard("opened"), self._av.open(str(path)) as container:
            # Only a decoded picture says how the file wants to be turned.
            first = next(container.decode(container.streams[self._stream]), None)
        self._matrix = display_matrix(first)
        self.size = self._stored[::-1] if _transposes(path, self._matrix) else self._stored
        #: Properties of the pictures that the file states and a run ignores, each with the remedy.
        self.doubts = _doubts(first, others)
        self._pts = sorted(pts for pts, *_ in table)[:frames]
        if frames is not None and len(self._pts) < frames:
            raise SourceError(
                f"{path}: {frames} frames are declared, the video holds {len(self._pts)}: lower 'frames', or leave it "
                "out where all cameras are videos"
            )
        self.num_frames, self.numbers = len(self._pts), range(len(self._pts))
        self._keys = sorted(
            (pts, pts if dts is None else dts) for pts, dts, key, _ in packets if key and pts is not None
        )

    @property
    def fps(self) -> float:
        """Frames per second, from the median distance of time stamps; 30 for a single picture.

        The rate that the file states, where its clock is too coarse to tell the two apart.
        """
        if len(self._pts) < 2:
            return 30.0
        # Coarse clocks give 29.97 fps steps of 33 and 34 ticks: the mean of the ordinary ones is exact.
        steps = np.diff(np.array(self._pts, np.float64))
        ordinary = steps[np.abs(steps - median(steps)) <= 1.5]
        mean = float(ordinary.mean())
        if self._stated and abs(1 / float(self._stated * self._base) - mean) * len(ordinary) < 1:
            return float(self._stated)
        return 1 / (mean * float(self._base))

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

    def read(self, index: int, target: tuple[int, int]) -> Any:
        """Decode one picture. Raises SourceError naming file and frame when the data is damaged."""
        with self._lock, self._guard(f"decoded at frame {index}"):
            try:
                pixels = self._decode(index)
            except BaseException:
                self._drop()
                raise
        if target == self.size and not self.deep:
            return pixels
        return shrink(pixels, target) / np.float32(65535 if self.deep else 255)

    def close(self) -> None:
        with self._lock:
            self._drop()

    def _film(self, container: Any) -> tuple[Any, int]:
        """The picture stream with the most pictures that is no cover picture, and how many others have several."""
        attached = self._av.stream.Disposition.attached_pic
        streams = [stream for stream in container.streams.video if not stream.disposition & attached]
        if not streams:
            raise SourceError(f"{self._path}: no picture stream in this file")
        counts = {stream.index: 0 for stream in streams}
        if len(streams) > 1:  # not every container says how many pictures a stream has
            with self._av.open(str(self._path)) as other:
                for packet in other.demux([other.streams[index] for index in counts]):
                    counts[packet.stream_index] += bool(packet.size)
        stream = max(streams, key=lambda stream: counts[stream.index])  # the first of equals
        if stream.codec_context is None or not stream.codec_context.width:
            raise SourceError(f"{self._path}: the picture stream cannot be decoded here; re-encode it as H.264")
        return stream, sum(count > 1 for count in counts.values()) - 1

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
            context = self._container.streams[self._stream].codec_context
            # One thread per file: a rig has tens of them. Damage is an error, not a picture patched up in silence.
            context.thread_count = 1
            context.options = {"err_detect": "explode"}
        stream = self._container.streams[self._stream]
        place = bisect.bisect_right(self._keys, (wanted, 2**62)) - 1
        if place < 0:
            raise SourceError(f"{self._path}: no key frame before time stamp {wanted}; re-encode the video")
        self._container.seek(self._keys[place][1], stream=stream, backward=True, any_frame=False)
        self._frames = self._container.decode(stream)

    def _pixels(self, frame: Any, index: int) -> np.ndarray[Any, Any]:
        if frame.is_corrupt:
            raise SourceError(f"{self._path}: frame {index} is damaged; copy or record the video again")
        if (frame.width, frame.height) != self._stored or display_matrix(frame) != self._matrix:
            raise SourceError(
                f"{self._path}: frame {index} is {frame.width} x {frame.height}, display matrix "
                f"{display_matrix(frame)}, the first was {self._stored[0]} x {self._stored[1]}, {self._matrix}; "
                "re-encode the video at one size"
            )
        # One thread, or each picture starts and ends a pool of them, one for each processor, which takes milliseconds.
        pixels: np.ndarray[Any, Any] = frame.to_ndarray(format="rgb48le" if self.deep else "rgb24", threads=1)
        return upright(pixels, self._matrix, self._path)

    def _drop(self) -> None:
        if self._container is not None:
            self._container.close()
        self._container = self._frames = None

    def _guard(self, doing: str) -> _AvErrors:
        return _AvErrors(self._path, doing, self._av)


def display_matrix(frame: Any) -> Matrix:
    """Return how a decoded picture is to be shown: (a, b, c, d), which shows what lies at x, y at a x + c y, b x + d y.

    Only the signs count, and a number of less than a hundredth of the largest is 0. A frame without a matrix, or None,
    gives (1, 0, 0, 1).
    """
    from av.sidedata.sidedata import Type

    found = None if frame is None else frame.side_data.get(Type.DISPLAYMATRIX)
    if found is None:
        return _AS_STORED
    numbers = np.frombuffer(bytes(found), np.int32)[[0, 1, 3, 4]].astype(np.int64)
    a, b, c, d = np.sign(np.where(100 * np.abs(numbers) < np.abs(numbers).max(), 0, numbers)).tolist()
    return a, b, c, d


def upright(pixels: np.ndarray[Any, Any], matrix: Matrix, path: Path) -> np.ndarray[Any, Any]:
    """Turn and mirror [H, W, 3] pixels as the file's display matrix says.

    Raises SourceError for a matrix that turns by no multiple of 90 degrees.
    """
    across, down = (matrix[2], matrix[1]) if _transposes(path, matrix) else (matrix[0], matrix[3])
    if _transposes(path, matrix):
        pixels = pixels.transpose(1, 0, 2)
    return np.ascontiguousarray(pixels[::down, ::across])


def _transposes(path: Path, matrix: Matrix) -> bool:
    """Whether rows become columns."""
    a, b, c, d = matrix
    if not (a and d and not (b or c)) and not (b and c and not (a or d)):
        raise SourceError(
            f"{path}: the file says to turn its pictures by an angle that is no multiple of 90 degrees: re-encode it"
        )
    return bool(b)


def _doubts(frame: Any, others: int) -> tuple[str, ...]:
    doubts = []
    if others > 0:
        doubts.append(f"{others + 1} films in one file; the one with the most pictures is read: split the file")
    if frame is not None and (curve := _CURVES.get(int(frame.color_trc))):
        doubts.append(
            f"high dynamic range ({curve}): values are taken as those of an ordinary screen, which looks washed out; "
            "convert the video to BT.709 (record without HDR, or tone-map it)"
        )
    if frame is not None and frame.interlaced_frame:
        doubts.append("interlaced pictures, which comb where something moves: ffmpeg -i IN -vf bwdif -crf 12 OUT.mp4")
    return tuple(doubts)


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
