"""Residual: quantised changes of the attributes of Gaussians whose gate is open."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from gsstream.core.changes.scene import Layout
from gsstream.core.errors import ShapeError
from gsstream.core.gaussians import ATTRIBUTES, Gaussians
from gsstream.core.shapes import FloatArray, IntArray


@dataclass(frozen=True, slots=True)
class Residual:
    """Rows behind open gates move by ``gate * (step * symbols) decoder``.

    Arguments:
        gates: [M] uint8 gate values; 0 is closed, ``num_levels`` is fully open.
        num_levels: 1 (binary) to 255.
        symbols: attribute -> [A, L] int32 residual symbols of the A Gaussians behind open gates, in storage order.
            An attribute without an entry does not change.
        steps: attribute -> quantisation step (position: fraction of the row's unit).
        decoders: attribute -> [L, D] float32 linear decoder; an attribute without one uses its symbols directly.
    """

    gates: IntArray
    num_levels: int
    symbols: Mapping[str, IntArray] = field(default_factory=dict)
    steps: Mapping[str, float] = field(default_factory=dict)
    decoders: Mapping[str, FloatArray] = field(default_factory=dict)

    @property
    def is_empty(self) -> bool:
        """Whether every gate is closed."""
        return not bool(np.any(self.gates))


def sent_rows(layout: Layout, gates: IntArray) -> IntArray:
    """Return [A] int64 rows of the Gaussians whose node has a non-zero gate, ascending."""
    opened = np.flatnonzero(gates)
    counts = np.asarray(layout.node_counts)[opened].astype(np.int64)
    starts = np.cumsum(layout.node_counts, dtype=np.int64)[opened] - counts
    # Runs of consecutive rows: starts[k] + 0, 1, ... counts[k] - 1.
    before = np.cumsum(counts) - counts
    return np.asarray(np.repeat(starts - before, counts) + np.arange(int(counts.sum())))


def changing_rows(residual: Residual) -> int:
    """Return how many of the rows behind open gates have a symbol that is not zero, in whatever attribute."""
    if not residual.symbols:
        return 0
    return int(np.count_nonzero(np.concatenate(list(residual.symbols.values()), axis=1).any(axis=1)))


def apply_residual(gaussians: Gaussians[FloatArray], layout: Layout, residual: Residual) -> Gaussians[FloatArray]:
    """Return the Gaussians after a residual, in raw values.

    a_t = a_{t-1} + g * (step * symbols) W.

    Rows behind closed gates keep their bits. All arithmetic is float32 in a fixed order. Raises ShapeError when the
    residual does not fit the scene.
    """
    _check_fit(layout, residual)
    index = sent_rows(layout, residual.gates)
    if len(index) == 0:
        return gaussians
    opened = np.flatnonzero(residual.gates)
    levels = residual.gates[opened].astype(np.float32) / np.float32(residual.num_levels)
    gate = np.repeat(levels, layout.node_counts[opened])
    changed = dict(gaussians.items())
    for name in ATTRIBUTES:
        if name not in residual.symbols:
            continue
        base = changed[name]
        change = decode_residual(residual.symbols[name], residual.steps[name], residual.decoders.get(name))
        if change.shape != (len(index), int(np.prod(base.shape[1:]))):
            raise ShapeError(
                f"residual of {name}: expected {len(index)} rows of {int(np.prod(base.shape[1:]))} values, "
                f"got {list(change.shape)}; the packet belongs to another scene"
            )
        scale = gate * layout.units_of(index) if name == "means" else gate
        change *= scale[:, None]
        # Flattened to rows first, because gathering and scattering whole rows is several times faster.
        out = base.reshape(len(base), -1).copy()
        out[index] = out.take(index, axis=0) + change
        changed[name] = out.reshape(base.shape)
    return Gaussians(**changed)


def _check_fit(layout: Layout, residual: Residual) -> None:
    if residual.gates.shape != layout.node_counts.shape:
        raise ShapeError(
            f"gates: expected one for each of {len(layout.node_counts)} nodes, got shape {list(residual.gates.shape)}; "
            "the packet belongs to another scene"
        )
    if residual.gates.size and int(residual.gates.max()) > residual.num_levels:
        raise ShapeError(f"gates: expected levels 0 to {residual.num_levels}, got {int(residual.gates.max())}")
    for name, symbols in residual.symbols.items():
        if name not in ATTRIBUTES:
            raise ShapeError(f"symbols: expected attributes among {', '.join(ATTRIBUTES)}, got {name!r}")
        if name not in residual.steps:
            raise ShapeError(f"steps: expected one for every coded attribute, got none for {name!r}")
        decoder = residual.decoders.get(name)
        channels = symbols.shape[1] if decoder is None else decoder.shape[0]
        if symbols.shape[1] != channels:
            raise ShapeError(
                f"decoder of {name}: expected {symbols.shape[1]} rows (one per latent channel), got {channels}"
            )


def decode_residual(symbols: IntArray, step: float, decoder: FloatArray | None) -> FloatArray:
    """Return the ungated residual [A, D] float32 of [A, L] symbols; without a decoder [L, D] the latents are it.

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
