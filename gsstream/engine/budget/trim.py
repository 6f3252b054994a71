"""Making a finished packet fit: symbols that explain little per bit go first, then whole gates, then everything.

What a symbol is worth is read from the optimiser: the running mean of a latent's squared gradient stands for its
curvature (empirical Fisher), so moving it by d costs about curvature * d^2 of loss, up to one factor for all. What it
costs is its code length in its channel's histogram. Each symbol then takes the cheapest of itself, one step nearer to
zero, and zero, at a weight of loss per bit that is raised until the packet fits (rate-distortion optimised
quantisation).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gsstream.core.changes import Delta, Layout, Residual
from gsstream.core.shapes import BoolArray, FloatArray, IntArray
from gsstream.packet import EncodedPacket

#: Most packets that are encoded in search of one that fits, and the share of the limit that counts as close enough.
TRIES, GOOD_ENOUGH = 8, 0.95
#: Steps of the search for a weight per bit; bits that an open gate takes besides its rows.
_BISECTIONS, _GATE_BITS = 24, 3.0


@dataclass(frozen=True)
class TrimmedDelta:
    """A packet that fits, of a delta of which something may have been given up.

    Arguments:
        delta: what is sent, as ``packet``.
        packet: its packet.
        whole: what was asked for.
        untrimmed: bytes of the packet of ``whole``.
        layout: layout of the scene before the packet.
    """

    delta: Delta
    packet: EncodedPacket
    whole: Delta
    untrimmed: int
    layout: Layout

    def given_up(self) -> dict[str, int]:
        """Count the symbols that are not as they were, the open gates and the added Gaussians that are not sent."""
        counts = [{"gates": _open(delta), "added": _added(delta)} for delta in (self.whole, self.delta)]
        closed = {name: counts[0][name] - counts[1][name] for name in counts[0]}
        return {"symbols": _changed(self.whole, self.delta, self.layout), **closed}


def trim_to_size(
    delta: Delta,
    packet: EncodedPacket,
    curvature: Mapping[str, FloatArray],
    layout: Layout,
    encode: Callable[[Delta], EncodedPacket],
    max_bytes: int,
) -> TrimmedDelta:
    """Return the delta, with as little given up as makes its packet fit; unchanged when it fits already."""
    untrimmed = len(packet.data)
    if untrimmed <= max_bytes:
        return TrimmedDelta(delta, packet, delta, untrimmed, layout)
    able = delta.residual is not None and delta.residual.symbols
    found = _trimmed(delta, packet, curvature, layout=layout, encode=encode, max_bytes=max_bytes) if able else None
    if found is None and delta.has_row_edit:
        # Added Gaussians cost most per row, so they are dropped first: without them the rest may fit.
        rest = delta.with_row_edit(None)
        plain = trim_to_size(rest, encode(rest), curvature, layout=layout, encode=encode, max_bytes=max_bytes)
        return replace(plain, whole=delta, untrimmed=untrimmed)
    if found is None:
        rest = Delta().with_light(delta.light)
        found = rest, encode(rest)
    assert len(found[1].data) <= max_bytes, "an empty packet is above the budget"
    return TrimmedDelta(*found, delta, untrimmed, layout)


def _trimmed(
    delta: Delta,
    packet: EncodedPacket,
    curvature: Mapping[str, FloatArray],
    layout: Layout,
    encode: Callable[[Delta], EncodedPacket],
    max_bytes: int,
) -> tuple[Delta, EncodedPacket] | None:
    """The largest packet found that fits, real bytes; None when none did."""
    assert delta.residual is not None
    table = _Table(delta.residual, curvature, layout)
    best: tuple[Delta, EncodedPacket] | None = None
    # Estimated bits and real bytes of a packet that fits and of one that does not; in between a straight line.
    low, high = (0.0, 0.0), (table.bits, float(len(packet.data)))
    for _ in range(TRIES):
        share = (0.98 * max_bytes - low[1]) / (high[1] - low[1])
        aim = low[0] + min(max(share, 0.05), 0.95) * (high[0] - low[0])
        smaller = delta.with_residual(table.at_most(aim))
        tried = encode(smaller)
        size = len(tried.data)
        if size > max_bytes:
            high = aim, float(size)
            continue
        low = aim, float(size)
        if smaller.residual is not None and (best is None or size > len(best[1].data)):
            best = smaller, tried
        if size >= GOOD_ENOUGH * max_bytes:
            break
    return best


class _Table:
    """Symbols of all attributes side by side with their worth and code lengths.

    A zero has no choice, and most symbols are zeros: only the K others are weighed against their bits.
    """

    def __init__(self, residual: Residual, curvature: Mapping[str, FloatArray], layout: Layout) -> None:
        self.residual = residual
        self.opened = np.flatnonzero((residual.gates > 0) & (np.asarray(layout.node_counts) > 0))
        self.counts = np.asarray(layout.node_counts)[self.opened]
        self.names = list(residual.symbols)
        self.symbols = symbols = np.concatenate([residual.symbols[n] for n in self.names], 1).astype(np.int64)
        codes = [_code_lengths(column) for column in symbols.T]
        self.place = rows, columns = symbols.nonzero()
        gate = np.repeat(np.arange(len(self.opened)), self.counts)
        zeros = np.where(symbols == 0, [code(np.zeros(1, np.int64))[0] for code in codes], 0.0).sum(1)
        #: [G] bits of each open gate together with the zeros behind it.
        self.fixed = np.bincount(gate, zeros, len(self.opened)) + _GATE_BITS
        self.gate = gate[rows]
        steps = [np.full(residual.symbols[n].shape[1], residual.steps[n]) for n in self.names]
        worth = np.concatenate([np.asarray(curvature[n], np.float64) for n in self.names], 1)[rows, columns]
        worth *= np.concatenate(steps)[columns] ** 2
        kept = symbols[rows, columns]
        #: The three choices of every symbol that is not zero: [3, K] values, what they lose and what they cost.
        self.values = np.stack([kept, kept - np.sign(kept), np.zeros_like(kept)])
        self.losses = worth[None] * (self.values - kept[None]) ** 2
        self.lengths = np.zeros(self.values.shape)
        for channel, code in enumerate(codes):
            of = np.flatnonzero(columns == channel)
            self.lengths[:, of] = code(self.values[:, of])
        self.closed = self._by_gate(self.losses[2])
        self.bits = float(self.lengths[0].sum() + self.fixed.sum())
        #: A weight at which nothing is worth its bits.
        self.most = float(self.losses[2].sum()) + 1e-30

    def at_most(self, bits: float) -> Residual | None:
        """The residual at the lowest weight at which it is estimated to take no more than ``bits``; None: nothing."""
        low, high = self.most * 1e-14, self.most * 10
        if self._choose(low)[2] <= bits:
            return self._residual(*self._choose(low)[:2])
        for _ in range(_BISECTIONS):
            middle = float(np.sqrt(low * high))
            low, high = (low, middle) if self._choose(middle)[2] <= bits else (middle, high)
        return self._residual(*self._choose(high)[:2])

    def _choose(self, rd_lambda: float) -> tuple[IntArray, BoolArray, float]:
        """(symbols [K], open [G] of the gates, bits) at a weight of loss per bit."""
        costs = self.losses + rd_lambda * self.lengths
        nearer = costs[1] < costs[0]
        zero = costs[2] < np.where(nearer, costs[1], costs[0])  # of equal costs the first, as argmin would have it

        def chosen(of: Any) -> Any:
            return np.where(zero, of[2], np.where(nearer, of[1], of[0]))

        length = self._by_gate(chosen(self.lengths)) + self.fixed
        opened = self.closed > self._by_gate(chosen(self.losses)) + rd_lambda * length
        return chosen(self.values), opened, float(length[opened].sum())

    def _by_gate(self, values: FloatArray) -> FloatArray:
        """[G] sums over the symbols behind each open gate."""
        return np.asarray(np.bincount(self.gate, values, len(self.opened)), np.float64)

    def _residual(self, values: IntArray, opened: BoolArray) -> Residual | None:
        # A gate behind which every symbol is zero is closed, as in hardening.
        opened = opened & (self._by_gate((values != 0).astype(np.float64)) > 0)
        if not opened.any():
            return None
        rows = np.repeat(opened, self.counts)
        gates = self.residual.gates.copy()
        gates[self.opened[~opened]] = 0
        kept = np.zeros_like(self.symbols)
        kept[self.place] = values
        symbols, at = {}, 0
        for name in self.names:
            width = self.residual.symbols[name].shape[1]
            part = kept[rows, at : at + width].astype(np.int32)
            at += width
            if part.any():
                symbols[name] = part
        decoders = {n: v for n, v in self.residual.decoders.items() if n in symbols}
        steps = {n: self.residual.steps[n] for n in symbols}
        return replace(self.residual, gates=gates, symbols=symbols, steps=steps, decoders=decoders)


def _code_lengths(column: IntArray) -> Callable[[IntArray], FloatArray]:
    """Bits of symbols under the histogram of ``column``; what it lacks is as rare as half a symbol."""
    low = min(int(column.min()), 0) - 1
    counts = np.bincount(column - low, minlength=int(max(column.max(), 0)) - low + 2).astype(np.float64)
    lengths = np.log2(len(column)) - np.log2(np.maximum(counts, 0.5))
    return lambda values: np.asarray(lengths[values - low])


def _open(delta: Delta) -> int:
    return 0 if delta.residual is None else int(np.count_nonzero(delta.residual.gates))


def _added(delta: Delta) -> int:
    return 0 if delta.added is None else len(delta.added)


def _changed(before: Delta, after: Delta, layout: Layout) -> int:
    """Symbols that are not as they were; those of rows that are no longer sent count when they were not zero."""
    if before.residual is None:
        return 0
    opened = np.flatnonzero(before.residual.gates)
    gates, symbols = after.gates(layout), {} if after.residual is None else after.residual.symbols
    kept = np.repeat(gates[opened] != 0, np.asarray(layout.node_counts)[opened])
    changed = 0
    for name, table in before.residual.symbols.items():
        now = np.zeros_like(table)
        if name in symbols:
            now[kept] = symbols[name]
        changed += int((now != table).sum())
    return changed
