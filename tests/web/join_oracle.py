"""A join read back: what the browser's player does, in numpy, for the tests of what writes them."""

from __future__ import annotations

import json
import zlib
from dataclasses import replace
from typing import Any

import numpy as np

from gsstream.core.changes import Displacement, Groups, Layout, Scene
from gsstream.core.errors import PacketError
from gsstream.core.gaussians import Gaussians
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.packet import PlayerState
from gsstream.packet.bits import decompress
from gsstream.serve.joins import MAGIC, VERSION, _bits, _origin

_HEADER = 24
_LIMIT = 1 << 30


def decode_join(key: PlayerState, data: bytes) -> PlayerState:
    """Return the state that a join leads to. Raises PacketError when it is damaged or belongs to another key packet."""
    if len(data) < _HEADER or data[:4] != MAGIC:
        raise PacketError("not a join of a gsstream package", 0)
    version, key_frame, frame, size, checksum = (int(v) for v in np.frombuffer(data, "<u4", 5, 4))
    packed = data[_HEADER:]
    if version != VERSION or key_frame != key.frame or len(packed) != size or zlib.crc32(packed) != checksum:
        raise PacketError(f"join of frame {frame} is damaged, of another version, or of another key packet", 4)
    cursor = _Cursor(decompress(packed, _LIMIT))
    facts = json.loads(cursor.take(int.from_bytes(cursor.take(4), "little")))
    number = facts["number"]
    source, layout = np.arange(number, dtype=np.int64), key.layout
    if facts["rows"] is not None:
        source = cursor.steps(number)
        counts = cursor.array("<i4", facts["rows"]["nodes"]).astype(np.int32)
        layout = Layout(counts, cursor.array(np.uint8, number), key.layout.units)
    values: dict[str, FloatArray] = {}
    for name, before in key.gaussians.items():
        width = int(np.prod(before.shape[1:]))
        changed = np.unpackbits(cursor.array(np.uint8, (number + 7) // 8), count=number).astype(bool)
        bits = _origin(_bits(before), source)
        bits[changed] += cursor.planes(facts["changed"][name], width)
        values[name] = bits.view(np.float32).reshape(number, *before.shape[1:])
    decoders = {name: cursor.array("<f4", a * b).reshape(a, b) for name, (a, b) in facts["decoders"].items()}
    groups, displacement = None, None
    if (said := facts["groups"]) is not None:
        groups = Groups(said["cell"], said["bins"], cursor.steps(number).astype(np.int32), said["count"])
    if (count := facts["displaced"]) is not None:
        rows = cursor.steps(count)
        translation, rotation = (cursor.planes(count, 3).view(np.float32) for _ in range(2))
        displacement = Displacement(rows, translation, rotation)
    scene = Scene(Gaussians(**values), layout, displacement, groups)
    meta = replace(key.meta, background=tuple(facts.get("background", key.meta.background)))
    return PlayerState(frame, scene, meta, decoders, key_rows=len(key.gaussians))


class _Cursor:
    """Takes arrays from bytes, one after the other."""

    def __init__(self, data: bytes) -> None:
        self.data, self.at = data, 0

    def take(self, size: int) -> bytes:
        if size < 0 or size > len(self.data) - self.at:
            raise PacketError(f"join: {size} bytes announced, {len(self.data) - self.at} left")
        self.at += size
        return self.data[self.at - size : self.at]

    def array(self, kind: str | type[np.generic], count: int) -> Any:
        return np.frombuffer(self.take(count * np.dtype(kind).itemsize), kind).copy()

    def steps(self, count: int) -> IntArray:
        return np.cumsum(self.array("<i4", count).astype(np.int64) + 1) - 1

    def planes(self, count: int, width: int) -> IntArray:
        planes = self.array(np.uint8, 4 * count * width).reshape(4, width, count).astype(np.uint32)
        folded = planes[0] | planes[1] << 8 | planes[2] << 16 | planes[3] << 24
        return np.ascontiguousarray(((folded >> 1) ^ -(folded & 1)).T).view(np.int32)
