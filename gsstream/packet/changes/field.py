"""The field of a delta packet: section field. The shape as it is, which rows move as runs, weights as symbols."""

from __future__ import annotations

import itertools
import struct

import numpy as np

from gsstream.core.changes import Field, FieldShape, Motion, Scene, field_rows
from gsstream.core.changes.field import MAX_ENTRY_STEP, MAX_WEIGHT_STEP, mismatch
from gsstream.core.changes.motion import apply_motions
from gsstream.core.errors import PacketError, ShapeError
from gsstream.core.shapes import IntArray
from gsstream.packet.base import Section, add_offset
from gsstream.packet.bits import pack_blobs, unpack_blobs
from gsstream.packet.gates import decode_gates, encode_gates
from gsstream.packet.symbols import decode_symbols, encode_symbols

#: Flags, levels, entries, features, width, layers; base; seed, both steps; growth, reach, both corners of the box.
_HEAD = struct.Struct("<BBBBBBHIII8f")
_MARKED = 1


def encode_field(change: Field) -> list[tuple[str, bytes]]:
    """Return the section that holds a field. Raises ShapeError for a bad one."""
    shape = change.shape
    problem = shape.problem() or _steps(change.entry_step, change.weight_step)
    tables = (*change.entries, *change.weights)
    if problem is None and len(tables) != shape.levels + shape.layers + 1:
        problem = f"expected tables of {shape.levels} levels and {shape.layers + 1} layers, got {len(tables)}"
    for table in tables:
        if problem is None and (table.ndim != 2 or table.dtype != np.int32):
            problem = f"symbols: expected tables of int32, got {table.dtype} {list(table.shape)}"
    if problem:
        raise ShapeError(f"field: {problem}")
    head = _HEAD.pack(
        _MARKED * (change.marks is not None),
        shape.levels,
        shape.entries,
        shape.features,
        shape.width,
        shape.layers,
        shape.base,
        shape.seed,
        change.entry_step,
        change.weight_step,
        shape.growth,
        shape.reach,
        *shape.low,
        *shape.high,
    )
    marks = b"" if change.marks is None else encode_gates(np.asarray(change.marks, np.uint8), 1)
    return [("field", head + pack_blobs([marks, *map(encode_symbols, tables)]))]


def decode_field(section: Section, scene: Scene, motions: tuple[Motion, ...]) -> Field:
    """Return the field of a frame. Raises PacketError."""
    with add_offset(section.offset):
        try:
            return _decode(section.data, apply_motions(scene, motions)[0])
        except ShapeError as error:
            raise PacketError(str(error)) from error


def _decode(data: bytes, scene: Scene) -> Field:
    if len(data) < _HEAD.size:
        raise PacketError("field cut short")
    flags, levels, entries, features, width, layers, base, seed, entry_step, weight_step, growth, reach, *box = (
        _HEAD.unpack_from(data)
    )
    if flags & ~_MARKED:
        raise PacketError(f"field: unknown flags {flags}; upgrade gsstream")
    shape = FieldShape(
        low=(box[0], box[1], box[2]),
        high=(box[3], box[4], box[5]),
        reach=reach,
        levels=levels,
        entries=entries,
        features=features,
        base=base,
        growth=growth,
        width=width,
        layers=layers,
        seed=seed,
    )
    problem = shape.problem() or _steps(entry_step, weight_step)
    if problem:
        raise PacketError(f"field: {problem}")
    blobs = unpack_blobs(data[_HEAD.size :], 1 + levels + layers + 1)
    marks: IntArray | None = None
    if flags & _MARKED:
        marks, num_levels = decode_gates(blobs[0], len(scene.gaussians))
        if num_levels != 1:
            raise PacketError("field: rows move or stand still, there are no levels")
    elif blobs[0]:
        raise PacketError("field: marks of rows, though all in the box move")
    _, unit = field_rows(scene, shape, marks)
    touched = shape.touched(unit)
    sizes = [(len(which), features) for which in touched]
    sizes += list(itertools.pairwise(shape.widths))
    tables = tuple(decode_symbols(blob, *size) for blob, size in zip(blobs[1:], sizes, strict=True))
    change = Field(
        shape=shape,
        marks=marks,
        entries=tables[:levels],
        weights=tables[levels:],
        entry_step=entry_step,
        weight_step=weight_step,
    )
    problem = mismatch(change, touched)
    if problem:
        raise PacketError(f"field: {problem}")
    return change


def _steps(entry_step: int, weight_step: int) -> str | None:
    """Why steps cannot be; None when they can."""
    for name, step, most in (("entry", entry_step, MAX_ENTRY_STEP), ("weight", weight_step, MAX_WEIGHT_STEP)):
        if not 1 <= step <= most:
            return f"step of {name} symbols: expected 1 to {most} units, got {step}"
    return None
