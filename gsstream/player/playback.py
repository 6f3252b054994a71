"""Playback: Gaussians at any frame of a stream. Numpy only; the decode functions are the encoder's own."""

from __future__ import annotations

import os
import warnings
from bisect import bisect_right
from collections.abc import Iterator
from typing import Literal

from gsstream.core.cameras import Cameras
from gsstream.core.errors import InputError, PacketError
from gsstream.core.gaussians import Gaussians
from gsstream.core.shapes import FloatArray
from gsstream.packet import Entry, PacketKind, PlayerState, StreamMeta, StreamReader, decode_packet
from gsstream.player.memory import MemoryLimit


class TruncatedStreamWarning(UserWarning):
    """The file ends in the middle of a packet: a run that is still writing, or was killed. What is before it plays."""


class Playback:
    """A stream seen as scenes by frame index. Stepping forward decodes one packet; seeking starts at a key packet.

    Several threads may ask one Playback for scenes: every answer is right, though threads that ask for places far apart
    make each other decode more; a Playback for each thread is faster. :meth:`refresh` and :meth:`close` are of one
    thread alone.
    """

    def __init__(self, path: str | os.PathLike[str], *, max_memory: int | None = None) -> None:
        """Open a stream. ``max_memory``: bytes that playing it may take; None: see ``gsstream.core.memory``.

        Raises SourceError when there is no stream, PacketError when its first packet is not readable, InputError when
        it would take more memory than allowed; so do all methods that decode.
        """
        self.reader = StreamReader(path)
        self.limit = MemoryLimit(max_memory)
        try:
            if not self.reader.frames:
                raise self.reader.damage or PacketError("the stream holds no complete packet yet", self.reader.end)
            self._entries = self.reader.frames
            self._state: PlayerState = self._decode(None, self._entries[0])
        except (PacketError, InputError):
            self.reader.close()
            raise

    def __enter__(self) -> Playback:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self.reader.close()

    def __len__(self) -> int:
        """Number of frames."""
        return len(self._entries)

    @property
    def frames(self) -> range:
        """Frame indices that can be asked for."""
        first = self._entries[0].frame
        return range(first, first + len(self._entries))

    @property
    def meta(self) -> StreamMeta:
        """Meta of the key packet last decoded."""
        return self._state.meta

    def cameras(self, split: Literal["train", "test"] = "test") -> Cameras:
        """Return the rig of a split."""
        return self.meta.test if split == "test" else self.meta.train

    def entry(self, frame: int) -> Entry:
        """Return kind, offset and size of a frame's packet.

        Raises InputError outside :attr:`frames`, or what damaged the packet.
        """
        if frame not in self.frames:
            if self.reader.damage is not None and frame > self.frames[-1]:
                raise self.reader.damage
            known = f"{self.frames[0]} to {self.frames[-1]}"
            raise InputError(f"frame {frame} is not in this stream: expected one of {known}")
        return self._entries[frame - self.frames[0]]

    def sound(self, start: int | None = None, stop: int | None = None) -> tuple[range, PacketError | None]:
        """Find out how far a stream can be played: reads the packets once and verifies their checksums.

        Arguments:
            start, stop: frames ``start`` to ``stop`` - 1 are wanted; default: from the first, to the last.

        Returns the wanted frames before the first damaged packet, and that damage; None where there is none. Where
        ``stop`` is not given, frames that are lost behind a damage count as wanted. Warns (TruncatedStreamWarning) when
        the last packet is not complete and the frames up to the last are wanted.

        Raises InputError for frames that are not in the stream, the damage when it leaves no frame to play.
        """
        first, end = self.frames[0], self.frames[-1] + 1
        start = first if start is None else start
        self.entry(start)
        if stop is not None and stop > end and self.reader.damage is None:
            self.entry(stop - 1)
        for entry in self._entries[self._key_before(start) - first : None if stop is None else max(0, stop - first)]:
            try:
                self.limit.check_packet(entry.size, entry.frame)
                self.reader.read(entry)
            except PacketError as error:
                if entry.frame <= start:
                    raise
                return range(start, entry.frame), error
        if stop is None and self.reader.unfinished is not None:
            tail = self.reader.unfinished
            warnings.warn(
                f"{self.reader.path} ends in an unfinished packet ({tail.size} bytes from byte {tail.offset}): its run "
                f"is still writing or was killed; frames {first} to {end - 1} are complete",
                TruncatedStreamWarning,
                stacklevel=2,
            )
        lost = self.reader.damage if stop is None or stop > end else None
        return range(start, end if stop is None else min(stop, end)), lost

    def state_at(self, frame: int) -> Gaussians[FloatArray]:
        """Decode the scene of a frame, from the nearest earlier key packet or the frame last asked for."""
        return self.player_state(frame).gaussians

    def player_state(self, frame: int) -> PlayerState:
        """Return scene, layout, decoders and last delta of a frame.

        Raises PacketError when a packet on the way is damaged.
        """
        self.entry(frame)
        first, start = self.frames[0], self._key_before(frame)
        state: PlayerState | None = None
        held = self._state  # read once: another thread may change it
        if start <= held.frame <= frame:
            state, start = held, held.frame + 1
        for entry in self._entries[start - first : frame - first + 1]:
            state = self._state = self._decode(state, entry)
        assert state is not None
        return state

    def __iter__(self) -> Iterator[tuple[int, Gaussians[FloatArray]]]:
        """(frame, scene) in order; then the damage that ends the file, if any, is raised."""
        for frame in self.frames:
            yield frame, self.state_at(frame)
        if self.reader.damage is not None:
            raise self.reader.damage

    def refresh(self) -> None:
        """Read the packets that a writer has added since."""
        self.reader.refresh()
        self._entries = self.reader.frames

    def _key_before(self, frame: int) -> int:
        """Frame of the last key packet up to ``frame``."""
        keys = [e.frame for e in self._entries if e.kind == PacketKind.KEY]
        return keys[bisect_right(keys, frame) - 1]

    def _decode(self, state: PlayerState | None, entry: Entry) -> PlayerState:
        self.limit.check_packet(entry.size, entry.frame)
        data = self.reader.read(entry)
        self.limit.check_decoding(data, state, entry.offset)
        return decode_packet(state, data, offset=entry.offset)
