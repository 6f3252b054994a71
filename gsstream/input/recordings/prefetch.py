"""Decode frames ahead of their use, on threads, with bounded memory."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType

from gsstream.core.errors import STRANGERS, EndOfRecording, GsstreamError, InputError, SourceError
from gsstream.core.frame import Frame
from gsstream.input.recordings.base import Source
from gsstream.input.recordings.canonical import to_file_coordinates

FramePair = tuple[Frame, Frame]
#: Bytes of a pair's images, as float32, from which only one pair is decoded ahead.
LARGE_PAIR = 64 << 20


class Prefetcher:
    """Iterate (training frame, test frame) pairs in the given order, at most ``depth`` pairs ahead of the consumer.

    An error while reading a frame is raised when its turn comes; iteration then ends, as at the end of a growing
    recording. Use as a context manager, or call ``close``, so that threads end. ``depth`` None: 2, and 1 where the
    images of one pair take more than ``LARGE_PAIR``. ``pack``: images wait as bytes where bytes hold them.
    """

    def __init__(
        self,
        source: Source,
        indices: Iterable[int],
        *,
        depth: int | None = None,
        workers: int = 1,
        pack: bool = False,
    ) -> None:
        if depth is None:
            depth = 1 if _pair_bytes(source) > LARGE_PAIR else 2
        if depth < 1 or workers < 1:
            raise InputError(f"prefetcher: depth and workers must be at least 1, got depth {depth}, workers {workers}")
        self._source, self._pack = source, pack
        self._todo = iter(indices)
        self._pending: deque[Future[FramePair]] = deque()
        self._pool = ThreadPoolExecutor(workers, thread_name_prefix="gsstream-prefetch")
        for _ in range(depth):
            self._submit()

    def __iter__(self) -> Iterator[FramePair]:
        return self

    def __next__(self) -> FramePair:
        if not self._pending:
            self.close()
            raise StopIteration
        try:
            pair = self._pending.popleft().result()
        except EndOfRecording:
            self.close()
            raise StopIteration from None
        except BaseException:
            self.close()
            raise
        self._submit()
        return pair

    def __enter__(self) -> Prefetcher:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Drop what is decoded, cancel what is queued and wait for the reads in progress (one pair per thread)."""
        for future in self._pending:
            future.cancel()
        self._pending.clear()
        self._todo = iter(())
        self._source.interrupt()
        self._pool.shutdown(wait=True, cancel_futures=True)

    def _submit(self) -> None:
        # Taking one index at a time keeps the bound even for an endless stream of indices.
        for index in self._todo:
            self._pending.append(self._pool.submit(_read_pair, self._source, index, self._pack))
            break


def _pair_bytes(source: Source) -> int:
    """Bytes of the images of one frame of all cameras, as float32."""
    return sum(12 * len(rig) * rig.width * rig.height for rig in (source.info.train, source.info.test))


def _read_pair(source: Source, index: int, pack: bool) -> FramePair:
    read = source.stored_frame if pack else source.frame
    try:
        return read(index, "train"), read(index, "test")
    except GsstreamError:
        raise
    except STRANGERS as error:  # a source may be a plugin's: its failure is reported with its name
        name = type(to_file_coordinates(source)).__name__
        raise SourceError(f"{name} could not read frame {index}: {type(error).__name__}: {error}") from error
