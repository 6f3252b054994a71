"""Coloured points of frame 0 from files: numpy archives beside cameras.json, and PLY as 3D tools write it.

PLY: ascii or little-endian binary, one row per vertex.
"""

from __future__ import annotations

import warnings
import zipfile
import zlib
from pathlib import Path

import numpy as np

from gsstream.core.errors import SourceError
from gsstream.core.frame import PointCloud
from gsstream.core.shapes import BoolArray, FloatArray
from gsstream.input.recordings.base import PointKind
from gsstream.input.recordings.sync import RecordingWarning

POINTS_FILE = "points_frame0.npz"
#: Points that whoever made them trusts less than this, from 0 to 1, are left out.
TRUSTED = 0.5
#: Steps of float32 above this share of the points' spread move them visibly.
COARSE = 1e-3

_TYPES = {
    "char": "i1", "uchar": "u1", "short": "<i2", "ushort": "<u2", "int": "<i4", "uint": "<u4", "float": "<f4",
    "double": "<f8", "int8": "i1", "uint8": "u1", "int16": "<i2", "uint16": "<u2", "int32": "<i4", "uint32": "<u4",
    "float32": "<f4", "float64": "<f8",
}  # fmt: skip
#: Longest header we read; a file without an end of header is not a PLY.
_HEADER_LIMIT = 65536
_MAX_POINTS = 200_000_000


def read_points(path: Path, kind: PointKind) -> PointCloud:
    """Read [P, 3] points and uint8 colours from an npz file, without those of a ``confidence`` [P] below a half.

    Raises SourceError naming file and array.
    """
    prefix = "" if kind == "recording" else "sparse_"
    try:
        with np.load(path, allow_pickle=False) as arrays:
            if not isinstance(arrays, np.lib.npyio.NpzFile):
                raise ValueError("it holds a single array (.npy)")
            names = list(arrays.files)
            missing = [n for n in (f"{prefix}xyz", f"{prefix}rgb") if n not in names]
            if missing:
                raise SourceError(f"{path}: no array {missing[0]!r} for points {kind!r}; it holds {', '.join(names)}")
            xyz, rgb = arrays[f"{prefix}xyz"], arrays[f"{prefix}rgb"]
            trust = arrays[f"{prefix}confidence"] if f"{prefix}confidence" in names else None
    except SourceError:
        raise
    except (OSError, ValueError, EOFError, TypeError, MemoryError, zipfile.BadZipFile, zlib.error) as error:
        raise SourceError(f"{path}: cannot be read as a numpy archive: {error}; write it with numpy.savez") from error
    shaped = xyz.ndim == 2 and xyz.shape[1] == 3 and rgb.shape == xyz.shape
    if not shaped or rgb.dtype != np.uint8 or xyz.dtype.kind not in "fiu":
        raise SourceError(
            f"{path}: expected {prefix}xyz [P, 3] float and {prefix}rgb [P, 3] uint8, "
            f"got {list(xyz.shape)} {xyz.dtype} and {list(rgb.shape)} {rgb.dtype}"
        )
    with np.errstate(over="ignore"):  # what does not fit into float32 becomes infinite and is refused
        fits = np.isfinite(xyz.astype(np.float32))
    if not fits.all():
        raise SourceError(f"{path}: {int((~fits).any(1).sum())} of {len(xyz)} points are not finite")
    if xyz.dtype == np.float32 and len(xyz) > 1:
        step = float(np.spacing(np.abs(xyz).max()))
        spread = float(np.median(np.abs(xyz - np.median(xyz, axis=0))))
        if step > COARSE * spread:
            warnings.warn(
                f"{path}: {prefix}xyz is float32, whose steps are {step:.2g} this far from the origin, and the points "
                f"spread over {spread:.2g}: write float64, or move poses and points to the origin",
                RecordingWarning,
                stacklevel=2,
            )
    if trust is not None:
        kept = _trusted(path, f"{prefix}confidence", trust, len(xyz))
        xyz, rgb = xyz[kept], rgb[kept]
    colors = rgb.astype(np.float32) / np.float32(255)
    return PointCloud(xyz.astype(np.float64), colors, f"{path.name} ({kind})")


def _trusted(path: Path, name: str, trust: FloatArray, count: int) -> BoolArray:
    """[P] bool: which points their maker trusts. Raises SourceError for other numbers, and where none are left."""
    if trust.shape != (count,) or trust.dtype.kind not in "fiu" or not ((trust >= 0) & (trust <= 1)).all():
        raise SourceError(f"{path}: expected {name} [{count}] from 0 to 1, got {list(trust.shape)} {trust.dtype}")
    kept: BoolArray = trust >= TRUSTED
    if not kept.any():
        raise SourceError(f"{path}: {name} is below {TRUSTED} for every point: scale it to 1, or leave the array out")
    return kept


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
