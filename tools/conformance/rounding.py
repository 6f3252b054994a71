"""Vectors in which sums cancel: a decoder that fuses, reorders or widens operations gives other bits, and -0 shows."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from gsstream.core.changes import Delta, Field, FieldShape, Motion, groups_for
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.packet.symbols import encode_symbols
from tools.conformance.coding import constant, parts, run_gates
from tools.conformance.keys import coded, flat
from tools.conformance.moving import moves
from tools.conformance.residuals import attribute
from tools.conformance.tapes import Sections, Tape, Vector, key_sections, layout, playing, scene

TINY = float(np.float32(1e-45))


def vectors() -> Iterator[Vector]:
    """Every vector of this module."""
    yield _turned_back()
    yield _far_and_back()
    yield _aligned()
    yield _orders()
    yield _remembered()
    yield _halves()
    yield _minus_zeros()


def rows_at(cells: IntArray, quats: IntArray | None = None, exponent: int = 0) -> Sections:
    """Return a key packet of rows at these cells times 2^exponent, each a node of its own."""
    number = len(cells)
    moved = np.diff(cells, axis=0, prepend=0).astype(np.int32)
    found = {**key_sections(scene(0, 0), layout(0, 0, 0, ())), **flat(number)}
    found["layout"] = struct.pack("<IIBf", number, number, 1, 1.0) + parts(constant(1, number), constant(0, number))
    found["means"] = struct.pack("<bbb", exponent, 127, exponent) + parts(encode_symbols(moved), b"")
    return found if quats is None else {**found, **coded("quats", quats, 4, 7)}


def every(tape: Tape, cell: float, symbols: IntArray, translation: float, rotation: float) -> Motion:
    """Return a motion of all groups, not predicted."""
    groups = groups_for(tape.here.scene, cell, 1)
    assert len(symbols) == groups.count, "a row of symbols for each group"
    moving = np.ones(groups.count, np.uint8)
    return Motion(cell, 1, moving, symbols.astype(np.int32), translation, rotation, predicted=False, regroup=True)


def _turned_back() -> Vector:
    """Each row is turned by almost the inverse of its rotation: what is left is small beside the products."""
    rng = np.random.default_rng(500)
    quats = np.column_stack([np.zeros(60, int), rng.integers(-60, 61, (60, 3)), rng.integers(0, 9, 60)])
    tape = Tape().key(rows_at(np.arange(180).reshape(60, 3), quats))
    raw = tape.here.gaussians.quats.astype(np.float64)
    symbols = np.zeros((60, 6), np.int64)
    symbols[:, 3:] = np.rint(-raw[:, 1:] / raw[:, :1] * 2.0**30)
    moves(tape, every(tape, 1.0, symbols, 1.0, 2.0**-30))
    return playing("rounding-turned-back", "rounding motion", "0.4-1 4.4-6", tape)


def _pairs(number: int, apart: int, seed: int) -> IntArray:
    """Return the cells of pairs of rows, each pair in a cell of a motion of its own: the second row is ``apart`` on."""
    rng = np.random.default_rng(seed)
    first = 1024 * (1 + rng.permutation(number * 3).reshape(number, 3))
    second = first + apart * (1 + rng.integers(0, 2, (number, 3)).clip(0, 1 if apart < 256 else 0))
    return np.stack([first, second], 1).reshape(-1, 3)


def _far_and_back() -> Vector:
    """Pairs of rows go far away, where their distance is one step of float32, and return so that one ends near 0."""
    number, step = 60, 2.0**21
    tape = Tape().key(rows_at(_pairs(number, 256, 501), exponent=20))
    cell = float(1 << 29)
    out = np.zeros((number, 6), np.int64)
    out[:, :3] = 1 << 30
    moves(tape, replace(every(tape, cell, out, step, 2.0**-20), regroup=False))
    here = tape.here
    assert here.scene.groups is not None, "the motion has named groups"
    group_of = here.scene.groups.group_of
    back = np.zeros((number, 6), np.int64)
    back[:, 3:] = np.random.default_rng(505).integers(-(1 << 20), 1 << 20, (number, 3))
    for group in range(number):
        pair = here.gaussians.means[group_of == group].astype(np.float64)
        turned = _turn(back[group, 3:] * 2.0**-20) @ (pair[0] - pair.mean(0))
        back[group, :3] = np.rint(-(pair.mean(0) + turned) / step)
    moves(tape, Motion(cell, 1, np.ones(number, np.uint8), back.astype(np.int32), step, 2.0**-20, predicted=False))
    return playing("rounding-far-and-back", "rounding motion", "0.4-1 4.4-6", tape)


def _turn(rotation: FloatArray) -> FloatArray:
    """The matrix of a rotation given as axis * tan(angle / 2), up to rounding."""
    from gsstream.core.changes.motion import quat_to_rotmat, rodrigues_to_quat

    return np.asarray(quat_to_rotmat(rodrigues_to_quat(rotation[None]))[0])


def _named(tape: Tape, cell: float) -> IntArray:
    """Let a motion of nobody name the groups; return the group of each row."""
    groups = groups_for(tape.here.scene, cell, 1)
    moves(tape, Motion(cell, 1, np.zeros(groups.count, np.uint8), np.zeros((0, 6), np.int32), 1.0, 1.0))
    return groups.group_of


def _everybody(tape: Tape) -> tuple[str, bytes]:
    return ("gates", run_gates([len(tape.here.gaussians)], 1))


def _aligned() -> Vector:
    """Pairs of rows around the origin are turned so that they lie along x: the other coordinates cancel."""
    rng = np.random.default_rng(502)
    number = 150
    tape = Tape().key(rows_at(_pairs(number, 100, 502)))
    group_of = _named(tape, 512.0)
    there = rng.integers(-(1 << 20), 1 << 20, (number, 3))
    wanted = np.stack([there, -there], 1).reshape(-1, 3)
    tape.delta([_everybody(tape), ("means", attribute(wanted - tape.here.gaussians.means.astype(np.int64), 1.0))])
    symbols = np.zeros((number, 6), np.int64)
    for row in range(0, 2 * number, 2):
        line = tape.here.gaussians.means[row].astype(np.float64)
        towards = np.array([float(np.linalg.norm(line)), 0.0, 0.0])
        turn = np.cross(line, towards) / (towards @ towards + line @ towards)
        symbols[group_of[row], 3:] = np.rint(turn * 2.0**26).clip(-(2.0**31), 2.0**31 - 1)
    moving = np.ones(number, np.uint8)
    moves(tape, Motion(512.0, 1, moving, symbols.astype(np.int32), 0.5, 2.0**-26, predicted=False))
    return playing("rounding-aligned", "rounding motion residual", "0.4-1 4.4-6", tape)


def _orders() -> Vector:
    """Rows of a group that lie very differently far away: the sum that gives their centre depends on its order."""
    rng = np.random.default_rng(506)
    cells = np.repeat(1024 * (1 + np.arange(20)[:, None] * np.ones(3, int)), 6, 0)
    tape = Tape().key(rows_at(cells))
    group_of = _named(tape, 512.0)
    symbols = np.zeros((120, 3), np.int64)
    symbols[0::6] = 1 << 30
    symbols[3::6] = -(1 << 30)
    tape.delta([_everybody(tape), ("means", attribute(symbols, 9e5))])
    symbols = rng.integers(-(1 << 20), 1 << 20, (120, 3)) * (np.arange(120) % 3 > 0)[:, None]
    tape.delta([_everybody(tape), ("means", attribute(symbols, 1e-3))])
    means, step = tape.here.gaussians.means.astype(np.float64), 2.0**19
    turns = np.zeros((20, 6), np.int64)
    turns[:, 3:] = rng.integers(-900, 900, (20, 3))
    for group in range(20):
        rows = means[group_of == group]
        turned = _turn(turns[group, 3:] * 2.0**-10) @ (rows[1] - rows.mean(0))
        turns[group, :3] = np.rint(-(rows.mean(0) + turned) / step)
    moving = np.ones(20, np.uint8)
    moves(tape, Motion(512.0, 1, moving, turns.astype(np.int32), step, 2.0**-10, predicted=False))
    return playing("rounding-orders", "rounding motion residual", "0.4-1", tape)


def _remembered() -> Vector:
    """A residual turns one row of each group by a hair; the other, which stands straight, then shows that rotation."""
    rng = np.random.default_rng(503)
    number = 60
    cells = (8 * np.arange(number)[:, None] + np.array([1, 3])).reshape(-1, 1) * np.ones(3, int)
    tape = Tape().key(rows_at(cells.astype(np.int64), np.zeros((2 * number, 5), int)))
    group_of = groups_for(tape.here.scene, 2.0, 1).group_of
    moving = np.zeros(2 * number, np.uint8)
    moving[group_of[0::2]] = 1
    turns = np.zeros((number, 6), np.int32)
    turns[:, 3:] = rng.integers(-(1 << 20), 1 << 20, (number, 3)) >> rng.integers(0, 12, (number, 3))
    moves(tape, Motion(2.0, 1, moving, turns, 1.0, 2.0**-20, predicted=False))
    symbols = np.zeros((2 * number, 4), np.int32)
    symbols[0::2] = rng.integers(-3, 4, (number, 4))
    tape.delta([_everybody(tape), ("quats", attribute(symbols, 2.0**-24))])
    together = groups_for(tape.here.scene, 8.0, 1).count
    none = np.zeros((together, 6), np.int32)
    moves(tape, Motion(8.0, 1, np.ones(together, np.uint8), none, 1.0, 1.0, predicted=True))
    return playing("rounding-remembered", "rounding motion residual", "0.4-1 4.3-1", tape)


def _halves() -> Vector:
    """Entries are interpolated to whole numbers and a half, up to the rounding of thirds, fifths and sevenths."""
    rng = np.random.default_rng(504)
    shape = FieldShape((0.0,) * 3, (210.0,) * 3, 1.0, 4, 3, 2, 1, 1.0, 16, 1, seed=9)
    tape = Tape()
    for _ in range(6):
        cells = np.column_stack([rng.integers(0, 211, 200), 210 * rng.integers(0, 2, (200, 2))])
        tape.key(rows_at(cells))
        entries = tuple(
            (rng.integers(-4000, 4000, (len(which), 2)) * 105 - shape.start_entries(level, which)).astype(np.int32)
            for level, which in enumerate(shape.touched(shape.unit(tape.here.gaussians.means)))
        )
        weights = tuple(
            (rng.integers(-9000, 9000, start.shape) - start).astype(np.int32) for start in shape.start_weights()
        )
        tape.change(Delta((Field(shape, None, entries, weights, 1, 1),)))
    return playing("rounding-halves", "rounding field", "0.4-1 4.5-8", tape)


def _minus_zeros() -> Vector:
    """Negative numbers too small for float32 become -0; a residual of zeros makes 0 of it, in sent attributes alone."""
    quats = np.zeros((8, 5), int)
    quats[:, 4] = -77  # a code of 51: 1 becomes 0.4
    cells = np.array([[0, 0, 0], [0, 0, 0], [9, 9, 9], [9, 9, 9], [0, 9, 0], [0, 9, 0], [9, 0, 9], [9, 0, 9]])
    tape = Tape().key(rows_at(cells, quats))
    symbols = np.zeros((4, 6), np.int64)
    symbols[:, 3:] = -1
    moves(tape, every(tape, 4.0, symbols, 1.0, TINY))
    some = [("gates", run_gates([2, 4, 2], 1)), ("quats", attribute(np.zeros((4, 4)), 0.5))]
    tape.delta(some)
    none = [("gates", run_gates([8], 1)), ("pattern", constant(0, 8)), ("quats", attribute(np.zeros((0, 4)), 0.5))]
    moves(tape, every(tape, 4.0, symbols, 1.0, TINY)).delta(none)
    moves(tape, every(tape, 4.0, symbols, 1.0, TINY)).delta(
        [("gates", run_gates([8], 1)), ("sh0", attribute(np.zeros((8, 3)), 0.5))]
    )
    latents = struct.pack("<BBB", 1, 1, 4) + np.array([1, -1, -1, 0], "<f2").tobytes()
    through = [("gates", run_gates([8], 1)), ("decoders", latents), ("quats", attribute(np.zeros((8, 1)), 0.5, 1))]
    tape.delta(through)
    # Half of the smallest number, as the mean of a row that went by it and one that did not, ties to 0.
    sole = np.array([[-1, -1, -1]] + [[0, 0, 0]] * 7, np.int32)
    tape.delta([("gates", run_gates([8], 1)), ("means", attribute(sole, TINY))])
    groups = groups_for(tape.here.scene, 4.0, 1)
    still = np.zeros((groups.count, 6), np.int32)
    moves(tape, Motion(4.0, 1, np.ones(groups.count, np.uint8), still, 1.0, 1.0, predicted=True))
    tape.delta([("gates", run_gates([8], 1)), ("means", attribute(np.zeros((8, 3)), 0.5))])
    return playing("rounding-minus-zeros", "rounding extremes motion residual", "0.4-1 4.6-8", tape)
