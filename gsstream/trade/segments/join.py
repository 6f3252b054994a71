"""Finished segments as one stream, and what the seams between them cost."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsstream.core.errors import OutputError, PacketError
from gsstream.packet import EncodedPacket, PacketKind, StreamReader, StreamWriter
from gsstream.trade.measure.records import mean


@dataclass(frozen=True, slots=True)
class Seam:
    """Where a segment begins. Quality is the mean PSNR over the test cameras, dB; None where nothing was measured.

    Arguments:
        frame: the key packet's.
        key_bytes: its size. What a delta packet would have cost in its place is not known; ``delta_bytes`` is the mean
            of the frames around it. None where a worker was killed between the packet and its line in the metrics.
        before, at, after: PSNR of the frame before, of the key frame and of the one after.
    """

    frame: int
    key_bytes: int | None
    delta_bytes: float
    before: float | None
    at: float | None
    after: float | None


def first_frame_of(path: Path) -> bytes:
    """Return the stream up to its first frame, as a stream of its own.

    Raises PacketError when that frame is not whole.
    """
    with StreamReader(path) as reader:
        if not reader.frames:
            raise reader.damage or PacketError(f"{path} holds no complete packet yet", reader.end)
        entry = reader.frames[0]
        reader.read(entry)
    return path.read_bytes()[: entry.offset + entry.size]


def join(streams: Sequence[Path], out: Path) -> None:
    """Write the packets of all streams, in their order, as one stream; ``out`` is there whole or not at all.

    Raises PacketError when a stream is damaged, does not begin with a key packet or does not go on where the one before
    ended; OutputError when ``out`` cannot be written.
    """
    part = out.with_suffix(".part")
    part.unlink(missing_ok=True)
    with StreamWriter.open(part) as writer:
        for path in streams:
            with StreamReader(path) as reader:
                reader.check()
                if not reader.frames or reader.frames[0].kind != PacketKind.KEY:
                    raise PacketError(f"{path} does not begin with a key packet: it cannot be played on its own", 0)
                for entry in reader.frames:
                    writer.append(EncodedPacket(reader.read(entry), {}))
    try:
        os.replace(part, out)
    except OSError as error:
        raise OutputError(f"cannot write {out}: {error.strerror}") from error


def seams(starts: Sequence[int], frames: Sequence[dict[str, Any]]) -> list[Seam]:
    """Return what each seam shows in the metrics of the joined frames."""
    found = []
    for start in starts:
        deltas = [_size(frame) for frame in frames if frame["status"] != "key" and abs(frame["frame"] - start) <= 3]
        place = {frame["frame"]: frame for frame in frames}
        before, at, after = (_psnr(place[index]) if index in place else None for index in (start - 1, start, start + 1))
        size = _size(place[start]) if start in place else None
        found.append(Seam(start, size, mean(deltas) if deltas else 0.0, before, at, after))
    return found


def _size(frame: dict[str, Any]) -> int:
    return int(sum(frame["bytes"].values()))


def _psnr(frame: dict[str, Any]) -> float | None:
    values = [value for value in frame.get("psnr", {}).values() if value is not None]
    return mean(values) if values else None
