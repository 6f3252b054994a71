"""Lines of ``metrics.jsonl`` for packets that have none: decoded frames are measured against the recording."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from gsstream.core.log import FrameLog
from gsstream.engine.run.blank import start_numbers
from gsstream.engine.run.displacement import displacement_pixels
from gsstream.engine.run.encoder import Encoder
from gsstream.engine.run.measure import HeldOut
from gsstream.engine.step.metrics import log_packet
from gsstream.input.recordings.base import Source
from gsstream.packet import EncodedPacket, PlayerState, StreamReader, decode_packet
from gsstream.packet.base import PACKET_HEADER, SECTION_HEADER, parse_packet


def measure_again(
    stream: Path, missing: Sequence[int], source: Source, encoder: Encoder, held_out: HeldOut | None
) -> Iterator[dict[str, Any]]:
    """Yield a line for each of these frames of a stream, which ascend.

    A line holds what packet and recording say: sizes, counts and quality. Numbers that only the encoder knew (seconds,
    iterations, latency) are lost. ``held_out``: None where the run measures nothing.
    """
    player: PlayerState | None = None
    with StreamReader(stream) as reader:
        for entry in reader.frames:
            if entry.frame > missing[-1]:
                return
            data = reader.read(entry)
            player = decode_packet(player, data, offset=entry.offset)
            if entry.frame not in missing:
                continue
            log = FrameLog()
            log_packet(log, player, EncodedPacket(data, _sizes(data)))
            line = {"frame": entry.frame, "status": entry.kind.name.lower(), **log.numbers, "live": None}
            line["displacement_pixels"] = displacement_pixels(player, source.info.train)
            if entry.frame == 0:
                line |= start_numbers(source.frame(0, "train"))
            if held_out is not None and len(source.info.test):
                line |= held_out.measure(player, encoder.with_near_plane(source.frame(entry.frame, "test")))
            yield line


def _sizes(data: bytes) -> dict[str, int]:
    """Bytes of a packet by section, as its encoder counted them."""
    _, sections = parse_packet(data)
    sizes = {name: len(section.data) for name, section in sections.items()}
    return {**sizes, "header": PACKET_HEADER.size + SECTION_HEADER.size * len(sections)}
