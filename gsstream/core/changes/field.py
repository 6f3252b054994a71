"""Field: a hash grid and a small network map a position in a box to the motion of Gaussians there (3DGStream).

The learned weights are transmitted as differences from weights that both ends draw from the same seed. Of the grid only
the entries around Gaussians of the field are transmitted; both ends compute which these are.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, replace

import numpy as np

from gsstream.core.changes.hashgrid import ENTRY_RANGE, WEIGHT_RANGE, FieldShape, evaluate_network
from gsstream.core.changes.motion import columns, quat_multiply, rodrigues_to_quat
from gsstream.core.changes.scene import Scene
from gsstream.core.errors import ShapeError
from gsstream.core.shapes import FloatArray, IntArray

#: Multiplications that one field may take, rows times the network: some seconds of a processor.
MAX_FLOPS = 1 << 35
#: Symbols times their step stay below this, in units; with what learning starts from, below the range of weights.
MAX_ENTRY_STEP, MAX_WEIGHT_STEP = 1 << ENTRY_RANGE - 1, 1 << WEIGHT_RANGE - 1
#: The real part of a quaternion stays above this, so that a turn is one.
MIN_REAL = 0.1


@dataclass(frozen=True, slots=True)
class Field:
    """What one frame learned.

    Arguments:
        shape: sizes of the grid and the network.
        marks: [N] uint8, 1 for rows that move where they lie in the box; None: all rows in the box.
        entries: for each level [E, F] int32 symbols of the entries that those rows touch, ascending.
        weights: for each layer [inputs, outputs] int32 symbols.
        entry_step: step of the symbols of entries, whole number of 2^-20.
        weight_step: step of the symbols of weights, whole number of 2^-14.
    """

    shape: FieldShape
    marks: IntArray | None
    entries: tuple[IntArray, ...] = field(repr=False)
    weights: tuple[IntArray, ...] = field(repr=False)
    entry_step: int
    weight_step: int

    @property
    def is_empty(self) -> bool:
        """Whether no row moves."""
        return self.marks is not None and not bool(np.any(self.marks))


def field_rows(scene: Scene, shape: FieldShape, marks: IntArray | None) -> tuple[IntArray, FloatArray]:
    """Return the rows [A] that a field moves, ascending, and where they are [A, 3], 0 to 1 in its box.

    Arguments:
        scene: decoded, as both ends have it.
        shape: shape of the field.
        marks: [N] uint8, 1 for rows that move where they lie in the box; None: all rows in the box.

    Raises ShapeError when the marks do not fit the scene or the field would take too long.
    """
    number = len(scene.gaussians)
    if marks is not None and marks.shape != (number,):
        raise ShapeError(
            f"field: expected a mark for each of {number} Gaussians, got shape {list(marks.shape)}; the packet belongs "
            "to another scene"
        )
    able = np.arange(number) if marks is None else np.flatnonzero(marks)
    unit = shape.unit(scene.gaussians.means.take(able, 0))
    inside = np.flatnonzero(((unit >= 0) & (unit <= 1)).all(1))
    if len(inside) * shape.flops > MAX_FLOPS:
        raise ShapeError(
            f"field: {len(inside)} Gaussians by {shape.flops} multiplications are more than {MAX_FLOPS}; expected a "
            "smaller network or fewer Gaussians"
        )
    return able.take(inside), unit.take(inside, 0)


def mismatch(change: Field, touched: list[IntArray]) -> str | None:
    """Say why the symbols of a field, whose rows touch these entries of each level, cannot be; None when they can."""
    shape = change.shape
    wanted = [(f"entries of level {i}", (len(which), shape.features)) for i, which in enumerate(touched)]
    wanted += [(f"layer {i}", pair) for i, pair in enumerate(itertools.pairwise(shape.widths))]
    said = (*change.entries, *change.weights)
    if len(said) != len(wanted):
        return f"expected tables of {len(wanted)} levels and layers, got {len(said)}"
    for number, ((name, form), symbols) in enumerate(zip(wanted, said, strict=True)):
        if symbols.shape != form:
            got = list(symbols.shape)
            return f"expected {list(form)} symbols of {name}, got {got}; the packet belongs to another scene"
        grid = number < shape.levels
        step, limit = (change.entry_step, MAX_ENTRY_STEP) if grid else (change.weight_step, MAX_WEIGHT_STEP)
        largest = step * int(np.abs(symbols.astype(np.int64)).max()) if symbols.size else 0
        if largest >= limit:
            return f"symbols of {name}: expected below {limit} units in size, got {largest}"
    return None


def apply_field(scene: Scene, change: Field) -> tuple[Scene, IntArray]:
    """Return the scene after a field, and the rows [A] that it moved. ``scene.displacement`` is not changed.

    Of the network's seven outputs the first three times the reach translate a centre; the other four rotate the row by
    the quaternion (1 + a, b, c, d). float64 in a fixed order, rounded to float32 at the end.

    Raises ShapeError when the field does not fit the scene.
    """
    shape = change.shape
    rows, unit = field_rows(scene, shape, change.marks)
    touched = shape.touched(unit)
    problem = mismatch(change, touched)
    if problem:
        raise ShapeError(f"field: {problem}")
    if not len(rows):
        return scene, rows
    entries: list[IntArray] = [
        shape.start_entries(level, which) + symbols.astype(np.int64) * change.entry_step
        for level, (which, symbols) in enumerate(zip(touched, change.entries, strict=True))
    ]
    weights: list[IntArray] = [
        start + symbols.astype(np.int64) * change.weight_step
        for start, symbols in zip(shape.start_weights(), change.weights, strict=True)
    ]
    said = evaluate_network(shape, unit, touched, entries=entries, weights=weights)
    gaussians = scene.gaussians
    # By the limits of weights and reach no shift is above 10^15, so what is finite stays so.
    there = gaussians.means.take(rows, 0).astype(np.float64) + said[:, :3] * shape.reach
    rotation = said[:, 4:] / np.maximum(1.0 + said[:, 3:4], MIN_REAL)
    means, quats = gaussians.means.copy(), gaussians.quats.copy()
    means[rows] = there.astype(np.float32)
    quats[rows] = quat_multiply(rodrigues_to_quat(rotation), columns(gaussians.quats, rows).T).astype(np.float32)
    return replace(scene, gaussians=replace(gaussians, means=means, quats=quats)), rows
