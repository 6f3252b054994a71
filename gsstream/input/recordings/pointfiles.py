"""Coloured points of frame 0 from files: numpy archives beside cameras.json, and PLY as 3D tools write it.

PLY: ascii or little-endian binary, one row per vertex, colours by their type.
"""

from __future__ import annotations

import warnings
import zipfile
import zlib
from pathlib import Path

import numpy as np

from gsstream.core.errors import SourceError
from gsstream.core.frame import PointCloud
from gsstream.core.gaussians import SH0
from gsstream.core.shapes import BoolArray, FloatArray
from gsstream.core.vertices import read_vertices
from gsstream.input.recordings.base import PointKind
from gsstream.input.recordings.images import check_unpacked
from gsstream.input.recordings.sync import RecordingWarning

POINTS_FILE = "points_frame0.npz"
#: Points whose confidence, as their file states it, is below this (0 to 1) are left out.
TRUSTED = 0.5
#: Steps of float32 above this share of the points' spread move them visibly.
COARSE = 1e-3
_CHANNELS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
_SPHERICAL = ("f_dc_0", "f_dc_1", "f_dc_2")


def read_points(path: Path, kind: PointKind) -> PointCloud:
    """Read [P, 3] points and uint8 colours from an npz file, without those of a ``confidence`` [P] below a half.

    Raises SourceError naming file and array.
    """
    prefix = "" if kind == "recording" else "sparse_"
    check_archive(path)
    try:
        with np.load(path, allow_pickle=False) as arrays:
            if not isinstance(arrays, np.lib.npyio.NpzFile):
                raise ValueError("it holds a single array (.npy)")
            names = list(arrays.files)
            missing = [n for n in (f"{prefix}xyz", f"{prefix}rgb") if n not in names]
            if missing:
                raise SourceError(
                    f"{path}: no array {missing[0]!r} for points {kind!r}; it holds {', '.join(names[:12])}"
                )
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


def check_archive(path: Path) -> None:
    """Raise SourceError for an archive whose arrays are far larger than the file, before they are unpacked."""
    try:
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
    except (OSError, ValueError, NotImplementedError, zipfile.BadZipFile):
        return  # what reads the points refuses such a file, and says what is wrong
    check_unpacked(path, size, "these are no points; write the points alone, with numpy.savez")


def read_ply_points(path: Path) -> PointCloud:
    """Read x, y, z and the colours of the element ``vertex``: bytes, 16 bits, floats to 1 or to 255, or harmonics.

    Grey 0.5 where there are none. Raises SourceError naming what is wrong: not a PLY, big-endian, no positions, cut
    short, not finite, colours of no known range.
    """
    try:
        table = read_vertices(path.read_bytes()).table
    except OSError as error:
        raise SourceError(f"{path}: cannot be read: {error}") from error
    except ValueError as error:
        raise SourceError(f"{path}: {error}") from error
    names = {name.lower(): name for name in table.dtype.names or ()}
    if not {"x", "y", "z"} <= set(names):
        raise SourceError(f"{path}: no x, y, z among the vertex properties {', '.join(names)}")
    xyz = np.stack([table[names[axis]] for axis in "xyz"], 1).astype(np.float64)
    if not np.isfinite(xyz).all():
        raise SourceError(f"{path}: {int((~np.isfinite(xyz)).any(1).sum())} of {len(xyz)} points are not finite")
    channels = next((known for known in (*_CHANNELS, _SPHERICAL) if set(known) <= set(names)), None)
    if channels is None:
        if others := [name for name in names if name not in ("x", "y", "z", "nx", "ny", "nz")]:
            message = f"{path}: no colours among the vertex properties {', '.join(others[:12])}; the points are grey"
            warnings.warn(message, RecordingWarning, stacklevel=2)
        return PointCloud(xyz, np.full(xyz.shape, 0.5, np.float32), path.name)
    values = np.stack([table[names[channel]] for channel in channels], 1)
    if channels is _SPHERICAL:
        return PointCloud(xyz, np.clip(0.5 + SH0 * values.astype(np.float32), 0, 1), path.name)
    return PointCloud(xyz, colours(str(path), values), path.name)


def colours(where: str, values: np.ndarray) -> FloatArray:
    """Return colours [P, 3] as float32 in [0, 1], by their type and their range.

    Bytes and whole numbers to 255 are divided by 255, other whole numbers by 65535; floats are taken as they are up to
    1, else divided by 255. Raises SourceError for any other range.
    """
    if not len(values):
        return np.zeros((0, 3), np.float32)
    low, high, whole = float(values.min()), float(values.max()), values.dtype.kind in "iu"
    most = next((bound for bound in ((255.0, 65535.0) if whole else (1.0, 255.0)) if high <= bound), 0.0)
    if not low >= 0 or not 0 <= high <= most:
        kind = "whole numbers to 255 or 65535" if whole else "numbers to 1 or 255"
        raise SourceError(f"{where}: colours of the type {values.dtype} from {low:g} to {high:g}; expected {kind}")
    out: FloatArray = values.astype(np.float32) / np.float32(most)
    return out
