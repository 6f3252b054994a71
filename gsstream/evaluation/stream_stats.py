"""What a stream costs: bytes by section and frame, beside entropy, the paper's estimate and a plain codec."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from statistics import median
from typing import Any

import numpy as np
import zstandard

from gsstream.core.changes import Delta, Residual, changing_rows, gather_rows, sent_rows
from gsstream.core.errors import PacketError
from gsstream.core.gaussians import ATTRIBUTES, Gaussians
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.packet import Entry, PacketKind, PlayerState, StreamReader, decode_packet
from gsstream.packet.base import parse_packet
from gsstream.packet.tables import coded_tables


@dataclass(frozen=True, slots=True)
class PacketStats:
    """One packet. Sizes in bytes."""

    frame: int
    kind: str  # key, delta or empty
    size: int  # all bytes of the packet
    sections: dict[str, int]  # section -> bytes; ``header`` holds all headers
    changed_gaussians: int  # rows with a residual that is not zero; all of them in a key packet
    #: sent_gaussians, open_gates: rows behind open gates, and these gates; all of them in a key packet.
    sent_gaussians: int
    open_gates: int
    coded: int  # bytes of the entropy-coded sections, the tables of their models included
    #: Empirical entropy of their symbols, each channel by itself or all together as they were modelled, and the bits
    #: sent plainly. coded / entropy is the coder's efficiency.
    entropy: float
    float16_zstd: int  # the same rows of the attributes that change, as float16 by zstandard level 19 (rows not named)
    #: The estimate of the S2GS paper (see :func:`paper_estimate`); no stream that can be decoded is that small.
    paper: float
    decode_ms: float  # wall time of decoding and updating the state, milliseconds


@dataclass(frozen=True, slots=True)
class StreamStats:
    """All packets of a stream."""

    packets: tuple[PacketStats, ...]
    #: num_gaussians, num_nodes: of the last key packet.
    num_gaussians: int
    num_nodes: int
    raw_key_bytes: int  # its attributes as float32
    fps: float  # pictures per second of the recording

    def of(self, *kinds: str) -> list[PacketStats]:
        """Return the packets of these kinds."""
        return [packet for packet in self.packets if packet.kind in kinds]

    @property
    def kb_per_frame(self) -> float | None:
        """Mean of delta and empty packets, 1 KB = 1,000 bytes; None without any."""
        return _mean([p.size / 1000 for p in self.of("delta", "empty")])

    @property
    def kb_amortised(self) -> float:
        """All bytes over all frames."""
        return sum(p.size for p in self.packets) / 1000 / len(self.packets)

    @property
    def mbit_per_second(self) -> float | None:
        """Rate of delta and empty packets at the recording's speed, 10^6 bits."""
        return None if self.kb_per_frame is None else self.kb_per_frame * 8e-3 * self.fps

    def efficiency(self, *kinds: str) -> float | None:
        """Return coded bytes over entropy, all packets of these kinds together."""
        chosen = self.of(*kinds)
        entropy = sum(p.entropy for p in chosen)
        return sum(p.coded for p in chosen) / entropy if entropy else None

    def sections(self, *kinds: str) -> dict[str, int]:
        """Return section -> bytes, all packets of these kinds together."""
        out: dict[str, int] = {}
        for packet in self.of(*kinds):
            for name, size in packet.sections.items():
                out[name] = out.get(name, 0) + size
        return out

    def summary(self) -> dict[str, Any]:
        """Return the numbers of a table row."""
        deltas, keys = self.of("delta"), self.of("key")
        coded, plain = (sum(getattr(p, name) for p in deltas) for name in ("coded", "float16_zstd"))
        return {
            "frames": len(self.packets),
            "gaussians": self.num_gaussians,
            "nodes": self.num_nodes,
            "fps": self.fps,
            "key_bytes": keys[-1].size,
            "key_raw_over_coded": self.raw_key_bytes / keys[-1].size,
            "kb_per_frame": self.kb_per_frame,
            "kb_amortised": self.kb_amortised,
            "mbit_per_second": self.mbit_per_second,
            "paper_kb_per_frame": _mean([p.paper / 1000 for p in self.of("delta", "empty")]),
            "paper_kb_with_frame_0": _mean([p.paper / 1000 for p in self.packets]),
            "key_coder_over_entropy": self.efficiency("key"),
            "delta_coder_over_entropy": self.efficiency("delta"),
            "float16_zstd_over_coded": plain / coded if coded else None,
            "sent_share": _mean([p.sent_gaussians / max(self.num_gaussians, 1) for p in self.of("delta", "empty")]),
            "delta_decode_ms_median": median(p.decode_ms for p in deltas) if deltas else None,
            "delta_decode_ms_most": max((p.decode_ms for p in deltas), default=None),
        }

    def to_json(self) -> str:
        """Return summary, sections and every packet."""
        data = {
            "summary": self.summary(),
            "key_sections": self.sections("key"),
            "delta_sections": self.sections("delta"),
            "packets": [asdict(packet) for packet in self.packets],
        }
        return json.dumps(data, indent=1, allow_nan=False)


def stream_stats(stream: str | os.PathLike[str], *, progress: Callable[[int, int], None] | None = None) -> StreamStats:
    """Decode every packet of a stream and measure it. Raises PacketError for a damaged stream."""
    packets: list[PacketStats] = []
    state: PlayerState | None = None
    raw = 0
    with StreamReader(stream) as reader:
        frames = reader.frames
        for done, entry in enumerate(frames, 1):
            data = reader.read(entry)
            started = time.perf_counter()
            state = decode_packet(state, data, offset=entry.offset)
            seconds = time.perf_counter() - started
            packets.append(_packet(entry, data, state, seconds))
            if entry.kind == PacketKind.KEY:
                raw = sum(array.nbytes for _, array in state.gaussians.items())
            if progress is not None:
                progress(done, len(frames))
        if reader.damage is not None:
            raise reader.damage
    if state is None:
        raise PacketError("the stream holds no complete packet yet", reader.end)
    return StreamStats(
        packets=tuple(packets),
        num_gaussians=len(state.gaussians),
        num_nodes=len(state.layout.node_counts),
        raw_key_bytes=raw,
        fps=state.meta.fps,
    )


def _changing(delta: Delta | None) -> int:
    return 0 if delta is None or delta.residual is None else changing_rows(delta.residual)


def paper_estimate(state: PlayerState, kind: PacketKind) -> float:
    """Return the bytes that the S2GS paper would report for this packet, by the size function of its released code.

    Frame 0: every attribute but positions and view-dependent colour as float32, position offsets as float32, and the
    zero-order entropy of the view-dependent colour. Later: decoders as float32 in every frame, position offsets of
    active Gaussians as float32, the entropy of the other symbols over all Gaussians (closed gates count as zeros) and
    of the open/closed map. Headers, model tables, gate levels and anchors are not counted there.
    """
    if kind == PacketKind.KEY:
        return _plain_estimate(state.gaussians)
    if state.delta is None:
        return 0.0
    assert state.before is not None
    delta, bits = state.delta, 0.0
    residual, gates = delta.residual or Residual(delta.gates(state.before), 1), delta.gates(state.before)
    bits += 32 * sum(decoder.size for decoder in residual.decoders.values())
    # The paper's method has no motions, light or network; by the paper's rule each of their numbers would be a float32.
    bits += sum(32 * motion.symbols.size for motion in delta.motions) + 96 * (delta.light is not None)
    if delta.field is not None:
        bits += sum(32 * table.size for table in (*delta.field.entries, *delta.field.weights))
    number, rows = len(state.before.unit_of), len(sent_rows(state.before, gates))
    for name, table in residual.symbols.items():
        if name == "means":
            bits += 96.0 * rows
            continue
        for column in table.T:
            bits += entropy_bits(np.concatenate([column, np.zeros(number - rows, column.dtype)]))
    added = 0.0 if delta.added is None else _plain_estimate(delta.added.gaussians)
    return (bits + entropy_bits(gates != 0)) / 8 + added


def _plain_estimate(gaussians: Gaussians[FloatArray]) -> float:
    """Bytes of whole Gaussians by the rule of frame 0; used for added ones too, which the paper's method lacks."""
    colors = np.asarray(gaussians.shN).reshape(len(gaussians), -1)
    plain = sum(array.nbytes for name, array in gaussians.items() if name != "shN")
    return float(plain) + sum(entropy_bits(column) for column in colors.T) / 8


def entropy_bits(values: Any) -> float:
    """Return the zero-order entropy of an array, bits in total."""
    _, counts = np.unique(values, return_counts=True)
    return float((counts * np.log2(counts.sum() / counts)).sum())


def float16_bytes(gaussians: Gaussians[FloatArray], names: Sequence[str], rows: IntArray) -> int:
    """Return the bytes of these rows as float16 by zstandard level 19, the size of a plain codec's packet."""
    parts = [getattr(gaussians, name)[rows].astype(np.float16).tobytes() for name in names]
    return len(zstandard.ZstdCompressor(level=19).compress(b"".join(parts)))


def _plain_bytes(state: PlayerState, rows: IntArray) -> int:
    """:func:`float16_bytes` of a packet: moved rows by what moved, whole Gaussians for keys and added Gaussians."""
    delta = state.delta
    if delta is None:
        return float16_bytes(state.gaussians, ATTRIBUTES, rows)
    added = 0
    if delta.added is not None:
        added = float16_bytes(delta.added.gaussians, ATTRIBUTES, np.arange(len(delta.added)))
    names = () if delta.residual is None else tuple(delta.residual.symbols)
    if not delta.has_row_edit:
        return float16_bytes(state.gaussians, names, rows)
    assert state.before is not None
    source = gather_rows(state.before.node_of, delta.added, delta.removed)
    return added + float16_bytes(state.gaussians, names, np.flatnonzero(np.isin(source, rows)))


def _packet(entry: Entry, data: bytes, state: PlayerState, seconds: float) -> PacketStats:
    _, sections = parse_packet(data, entry.offset)
    sizes = {name: len(section.data) for name, section in sections.items()}
    layout, delta = state.before or state.layout, state.delta
    rows = np.arange(len(state.gaussians)) if delta is None else sent_rows(layout, delta.gates(layout))
    empty = entry.kind == PacketKind.EMPTY
    tables = coded_tables(sections, entry.kind, layout)
    return PacketStats(
        frame=entry.frame,
        kind=entry.kind.name.lower(),
        size=entry.size,
        sections={**sizes, "header": entry.size - sum(sizes.values())},
        changed_gaussians=len(rows) if delta is None and not empty else _changing(delta),
        sent_gaussians=0 if empty else len(rows),
        open_gates=0 if empty else int(np.count_nonzero(delta.gates(layout))) if delta else len(layout.node_counts),
        coded=sum(table.size for table in tables),
        entropy=sum(table.entropy_bits for table in tables) / 8,
        float16_zstd=0 if empty else _plain_bytes(state, rows),
        paper=paper_estimate(state, entry.kind),
        decode_ms=1000 * seconds,
    )


def _mean(values: Sequence[float]) -> float | None:
    return sum(values) / len(values) if values else None
