"""Coloured points from PLY files, as 3D tools write them: ascii or little-endian binary, one row per vertex."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsstream.core.errors import SourceError
from gsstream.core.frame import PointCloud

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "<i2", "ushort": "<u2", "int": "<i4", "uint": "<u4", "float": "<f4",
    "double": "<f8", "int8": "i1", "uint8": "u1", "int16": "<i2", "uint16": "<u2", "int32": "<i4", "uint32": "<u4",
    "float32": "<f4", "float64": "<f8",
}  # fmt: skip
#: Longest header we read; a file without an end of header is not a PLY.
_HEADER_LIMIT = 65536
_MAX_POINTS = 200_000_000


def read_ply_points(path: Path) -> PointCloud:
    """Read x, y, z and red, green, blue (uint8; grey 0.5 when absent) of the first element, ``vertex``.

    Raises SourceError naming what is wrong: not a PLY, big-endian, no positions, cut short, not finite.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SourceError(f"{path}: cannot be read: {error}") from error
    end = data[:_HEADER_LIMIT].find(b"end_header")
    if not data.startswith(b"ply") or end < 0:
        raise SourceError(f"{path}: not a PLY file; expected a header from 'ply' to 'end_header'")
    body = data.find(b"\n", end) + 1
    lines = [line.split() for line in data[:end].decode("ascii", "replace").splitlines()]
    encoding, count, fields = _header(path, lines)
    table = _table(path, data[body:], encoding, count=count, fields=fields)
    names = table.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise SourceError(f"{path}: no x, y, z among the vertex properties {', '.join(names)}")
    xyz = np.stack([table[axis] for axis in "xyz"], 1).astype(np.float64)
    if not np.isfinite(xyz).all():
        raise SourceError(f"{path}: {int((~np.isfinite(xyz)).any(1).sum())} of {count} points are not finite")
    if {"red", "green", "blue"} <= set(names):
        rgb = np.stack([table[channel] for channel in ("red", "green", "blue")], 1).astype(np.float32) / 255
    else:
        rgb = np.full(xyz.shape, 0.5, np.float32)
    return PointCloud(xyz, rgb, path.name)


def _header(path: Path, lines: list[list[str]]) -> tuple[str, int, list[tuple[str, str]]]:
    encoding, count, fields, element = "", -1, [], ""
    for words in lines:
        if words[:1] == ["format"] and len(words) > 1:
            encoding = words[1]
        elif words[:1] == ["element"] and len(words) == 3:
            element = words[1]
            if element == "vertex" and words[2].isdigit():
                count = int(words[2])
            elif count < 0:
                raise SourceError(f"{path}: the first element is {element!r}; expected 'vertex' and its count")
        elif words[:1] == ["property"] and element == "vertex":
            if len(words) != 3 or words[1] not in _TYPES:
                raise SourceError(f"{path}: vertex property {' '.join(words[1:])!r} is not a plain number")
            fields.append((words[2], _TYPES[words[1]]))
    if encoding not in ("ascii", "binary_little_endian"):
        raise SourceError(f"{path}: format {encoding!r}; expected ascii or binary_little_endian")
    if not 0 <= count <= _MAX_POINTS or not fields or len({name for name, _ in fields}) < len(fields):
        raise SourceError(f"{path}: expected one 'element vertex COUNT' with differently named properties")
    return encoding, count, fields


def _table(path: Path, body: bytes, encoding: str, count: int, fields: list[tuple[str, str]]) -> np.ndarray:
    dtype = np.dtype(fields)
    if encoding == "binary_little_endian":
        if len(body) < count * dtype.itemsize:
            raise SourceError(f"{path}: cut short: {count} points need {count * dtype.itemsize} bytes, got {len(body)}")
        return np.frombuffer(body, dtype, count)
    rows = body.decode("ascii", "replace").splitlines()[:count]
    try:
        if len(rows) < count:
            raise ValueError(f"{count} rows are announced, {len(rows)} are there")
        numbers = [tuple(float(word) for word in row.split()) for row in rows]
        return np.array(numbers, dtype=[(name, "<f8") for name, _ in fields])
    except ValueError as error:
        raise SourceError(f"{path}: the rows cannot be read: {error}") from error
