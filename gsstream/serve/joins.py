"""Joins: the state in the middle of a segment, in a file beside the stream, so that no player replays it from its key.

A join says in which bits a state differs from that of the key packet before it. The stream is not touched, and a player
reaches the very state that its deltas lead to. Layout of the bytes: docs/reference/package-format.md.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import zstandard

from gsstream.core.shapes import FloatArray, IntArray
from gsstream.packet import PlayerState

MAGIC = b"GSSJ"
VERSION = 1
_LEVEL = 15


def encode_join(key: PlayerState, state: PlayerState, source: IntArray) -> bytes:
    """Return the file that leads from the state of a key packet to a later one."""
    facts: dict[str, Any] = {"number": len(state.gaussians), "decoders": {}, "groups": None}
    arrays: list[IntArray | FloatArray] = []
    same_rows = np.array_equal(source, np.arange(len(key.gaussians)))
    facts["rows"] = None if same_rows else {"nodes": len(state.layout.node_counts)}
    if not same_rows:
        arrays += [_steps(source), state.layout.node_counts.astype("<i4"), state.layout.unit_of.astype(np.uint8)]
    for name, before, now in _tables(key, state):
        difference = (_bits(now) - _origin(_bits(before), source)).astype(np.int32)
        changed = difference.any(axis=1)
        arrays += [np.packbits(changed), _planes(difference[changed])]
        facts.setdefault("changed", {})[name] = int(changed.sum())
    for name, decoder in state.decoders.items():
        facts["decoders"][name] = list(decoder.shape)
        arrays.append(decoder.astype("<f4"))
    if (groups := state.scene.groups) is not None:
        facts["groups"] = {"cell": groups.cell, "bins": groups.brightness_bins, "count": groups.count}
        arrays.append(_steps(groups.group_of))
    displacement = state.scene.displacement
    facts["displaced"] = None if displacement is None else len(displacement.rows)
    if displacement is not None:
        arrays.append(_steps(displacement.rows))
        arrays += [_planes(_bits(part)) for part in (displacement.translation, displacement.rotation)]
    if state.meta.background != key.meta.background:
        facts["background"] = state.meta.background
    head = json.dumps(facts, separators=(",", ":")).encode()
    body = len(head).to_bytes(4, "little") + head + b"".join(np.ascontiguousarray(a).tobytes() for a in arrays)
    packed = zstandard.ZstdCompressor(level=_LEVEL, write_content_size=True).compress(body)
    numbers = np.array([VERSION, key.frame, state.frame, len(packed), zlib.crc32(packed)], "<u4")
    return MAGIC + numbers.tobytes() + packed


def _tables(key: PlayerState, state: PlayerState) -> Iterator[tuple[str, FloatArray, FloatArray]]:
    for (name, before), (_, now) in zip(key.gaussians.items(), state.gaussians.items(), strict=True):
        yield name, before, now


def _bits(values: FloatArray) -> IntArray:
    """Return the bits of float32 values as int32, [N, W]; near values have near bits."""
    table = np.ascontiguousarray(values, np.float32)
    return table.reshape(len(table), int(np.prod(table.shape[1:]))).view(np.int32)


def _origin(bits: IntArray, source: IntArray) -> IntArray:
    """Return the bits [N, W] that each row had in the key packet, zeros for rows that were not there."""
    out = np.zeros((len(source), bits.shape[1]), np.int32)
    out[source >= 0] = bits[source[source >= 0]]
    return out


def _steps(values: IntArray) -> IntArray:
    """Return each value's difference to the one before, less one: zeros where values count up."""
    return np.diff(np.asarray(values, np.int64), prepend=-1).astype("<i4") - np.int32(1)


def _planes(values: IntArray) -> IntArray:
    """Return signed values [A, W], zigzag, as bytes by significance, channel after channel."""
    folded = ((values << 1) ^ (values >> 31)).view(np.uint32).T.ravel()
    return np.stack([(folded >> shift).astype(np.uint8) for shift in (0, 8, 16, 24)])
