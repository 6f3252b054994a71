"""Delta: what one frame changes, as the integers that are transmitted, and the one function that applies it.

Encoder and player call the same :func:`apply_delta` on numpy arrays, so the state they reach is equal by construction.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from gsstream.core.births import Births, check_births, check_deaths, gather_rows, join_rows, next_counts
from gsstream.core.errors import ShapeError
from gsstream.core.gaussians import ATTRIBUTES, Gaussians
from gsstream.core.shapes import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Layout:
    """How Gaussians are stored, known to both ends; between two key packets only births and deaths change it.

    Arguments:
        node_counts: [M] int32, number of Gaussians of each node; Gaussians are stored node by node.
        octree_levels: [N] uint8, level of each Gaussian's anchor.
        cell_sizes: [levels] float32, scene units; position residuals are measured in the cell of their level.
    """

    node_counts: IntArray
    octree_levels: IntArray
    cell_sizes: FloatArray

    @property
    def units(self) -> FloatArray:
        """[N] float32 length unit of each Gaussian's position residual."""
        return np.asarray(self.cell_sizes, np.float32)[self.octree_levels]

    def units_of(self, index: IntArray) -> FloatArray:
        """:attr:`units` of the Gaussians in rows ``index`` alone."""
        return np.asarray(self.cell_sizes, np.float32).take(self.octree_levels.take(index))

    @property
    def node_of(self) -> IntArray:
        """[N] int64 node of each Gaussian."""
        return np.repeat(np.arange(len(self.node_counts), dtype=np.int64), self.node_counts)


@dataclass(frozen=True, slots=True)
class Delta:
    """One frame's change: rows behind open gates move, then some are removed, then some are added.

    Arguments:
        gates: [M] uint8 gate levels; 0 is closed, ``num_levels`` is fully open.
        num_levels: 1 (binary) to 255.
        symbols: attribute -> [A, L] int32 residual symbols of the A Gaussians behind open gates, in storage order.
            An attribute without an entry does not change.
        steps: attribute -> quantisation step (position: fraction of the anchor's cell).
        decoders: attribute -> [L, D] float32 linear decoder; an attribute without one uses its symbols directly.
        births: Gaussians added, or None.
        deaths: [D] int64 rows removed (of the scene before the births), ascending.
    """

    gates: IntArray
    num_levels: int
    symbols: Mapping[str, IntArray] = field(default_factory=dict)
    steps: Mapping[str, float] = field(default_factory=dict)
    decoders: Mapping[str, FloatArray] = field(default_factory=dict)
    births: Births | None = None
    deaths: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))

    @property
    def is_empty(self) -> bool:
        return not bool(np.any(self.gates)) and not self.edits_rows

    @property
    def edits_rows(self) -> bool:
        """Whether Gaussians are added or removed."""
        return self.births is not None or len(self.deaths) > 0


def active_rows(layout: Layout, gates: IntArray) -> IntArray:
    """[A] int64 rows of the Gaussians whose node has a non-zero gate, ascending."""
    opened = np.flatnonzero(gates)
    counts = np.asarray(layout.node_counts)[opened].astype(np.int64)
    starts = np.cumsum(layout.node_counts, dtype=np.int64)[opened] - counts
    # Runs of consecutive rows: starts[k] + 0, 1, ... counts[k] - 1.
    before = np.cumsum(counts) - counts
    return np.asarray(np.repeat(starts - before, counts) + np.arange(int(counts.sum())))


def apply_delta(gaussians: Gaussians[FloatArray], layout: Layout, delta: Delta) -> Gaussians[FloatArray]:
    """Return the next frame's Gaussians: a_t = a_{t-1} + g * (step * symbols) W, in raw parameter space; then deaths
    leave and births join (:func:`next_layout` says where).

    Rows behind closed gates keep their bits. All arithmetic is float32 in a fixed order, so two calls on one machine
    agree bitwise. Raises ShapeError when the delta does not fit the scene.
    """
    _check_fit(layout, delta)
    moved = _move(gaussians, layout, delta)
    if not delta.edits_rows:
        return moved
    born = delta.births
    if born is not None:
        widths = [(name, int(np.prod(value.shape[1:]))) for name, value in moved.items()]
        check_births(born, len(layout.node_counts), len(layout.cell_sizes), widths)
    source = gather_rows(layout.node_of, born, delta.deaths)
    rows = {n: join_rows(v, None if born is None else getattr(born.gaussians, n), source) for n, v in moved.items()}
    return Gaussians(**rows)


def next_layout(layout: Layout, delta: Delta) -> Layout:
    """The layout after a delta's births and deaths; the same object when it has none."""
    if not delta.edits_rows:
        return layout
    node_of, born = layout.node_of, delta.births
    source = gather_rows(node_of, born, delta.deaths)
    levels = join_rows(layout.octree_levels, None if born is None else born.octree_levels, source)
    counts = next_counts(layout.node_counts, node_of, born, delta.deaths)
    return Layout(counts, levels.astype(np.uint8), layout.cell_sizes)


def row_gates(layout: Layout, delta: Delta) -> FloatArray:
    """[N'] float32 gate, 0 to 1, of every row after the delta; ``layout`` is that before it. Births count as open."""
    gates = np.repeat(delta.gates, layout.node_counts).astype(np.float32) / np.float32(delta.num_levels)
    if not delta.edits_rows:
        return np.asarray(gates)
    born = None if delta.births is None else np.ones(len(delta.births), np.float32)
    return join_rows(gates, born, gather_rows(layout.node_of, delta.births, delta.deaths))


def _move(gaussians: Gaussians[FloatArray], layout: Layout, delta: Delta) -> Gaussians[FloatArray]:
    """The Gaussians behind open gates changed; births and deaths not yet."""
    index = active_rows(layout, delta.gates)
    if len(index) == 0:
        return gaussians
    opened = np.flatnonzero(delta.gates)
    levels = delta.gates[opened].astype(np.float32) / np.float32(delta.num_levels)
    gate = np.repeat(levels, layout.node_counts[opened])
    changed = dict(gaussians.items())
    for name in ATTRIBUTES:
        if name not in delta.symbols:
            continue
        base = changed[name]
        change = decode_residual(delta.symbols[name], delta.steps[name], delta.decoders.get(name))
        if change.shape != (len(index), int(np.prod(base.shape[1:]))):
            raise ShapeError(
                f"delta of {name}: expected {len(index)} rows of {int(np.prod(base.shape[1:]))} values, "
                f"got {list(change.shape)}; the packet belongs to another scene"
            )
        scale = gate * layout.units_of(index) if name == "means" else gate
        change *= scale[:, None]
        # Rows first: taking and putting whole rows is several times faster than indexing the attribute's own shape.
        out = base.reshape(len(base), -1).copy()
        out[index] = out.take(index, axis=0) + change
        changed[name] = out.reshape(base.shape)
    return Gaussians(**changed)


def _check_fit(layout: Layout, delta: Delta) -> None:
    if delta.gates.shape != layout.node_counts.shape:
        raise ShapeError(
            f"gates: expected one for each of {len(layout.node_counts)} nodes, got shape {list(delta.gates.shape)}; "
            "the packet belongs to another scene"
        )
    if delta.gates.size and int(delta.gates.max()) > delta.num_levels:
        raise ShapeError(f"gates: expected levels 0 to {delta.num_levels}, got {int(delta.gates.max())}")
    check_deaths(delta.deaths, len(layout.octree_levels))
    for name, symbols in delta.symbols.items():
        if name not in ATTRIBUTES:
            raise ShapeError(f"symbols: expected attributes among {', '.join(ATTRIBUTES)}, got {name!r}")
        if name not in delta.steps:
            raise ShapeError(f"steps: expected one for every coded attribute, got none for {name!r}")
        decoder = delta.decoders.get(name)
        channels = symbols.shape[1] if decoder is None else decoder.shape[0]
        if symbols.shape[1] != channels:
            raise ShapeError(
                f"decoder of {name}: expected {symbols.shape[1]} rows (one per latent channel), got {channels}"
            )


def decode_residual(symbols: IntArray, step: float, decoder: FloatArray | None) -> FloatArray:
    """[A, D] float32 ungated residual of [A, L] symbols.

    The product is summed channel by channel with elementwise operations: a BLAS call may order its sums by the number
    of rows or threads, and then encoder and player would drift apart.
    """
    latent = symbols.astype(np.float32) * np.float32(step)
    if decoder is None:
        return latent
    out = latent[:, :1] * decoder[None, 0]
    term = np.empty_like(out)
    for channel in range(1, decoder.shape[0]):
        np.multiply(latent[:, channel : channel + 1], decoder[None, channel], out=term)
        out += term
    return out
