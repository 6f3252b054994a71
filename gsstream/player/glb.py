"""Binary glTF files with the extension KHR_gaussian_splatting (release candidate of 2026-04): one scene each.

Programs that do not know the extension show coloured points.
"""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np

from gsstream.core.errors import InputError
from gsstream.core.gaussians import SH0
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.player.activated import Activated

EXTENSION = "KHR_gaussian_splatting"
#: From axes forward, left, up to those of glTF, whose y is up and whose cameras look along -z.
AXES = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]])
#: What the extension is to know: colours are as recorded, not linear.
_SPLATS = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
_FLOAT, _UNSIGNED_SHORT, _ARRAY_BUFFER, _POINTS = 5126, 5123, 34962, 0
_HEAD, _CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
#: Bytes that the sizes in a file's head can count.
_MOST = 2**32 - 1


def glb_bytes(splats: Activated, to_recording: FloatArray) -> bytes:
    """Return a GLB of Gaussians in the axes of glTF; the same bytes for the same scene.

    ``to_recording`` [4, 4], from the file's coordinates to those of the recording, is stated in the extras of the
    scene, column by column as glTF writes matrices.

    Raises InputError for no Gaussians, which glTF cannot hold, and for more than 4 GB.
    """
    if len(splats) == 0:
        raise InputError("glTF holds no empty list of points, and this frame has no Gaussians; export ply")
    arrays = _attributes(splats)
    size = sum(array.nbytes for array in arrays.values())
    if size + 2**16 > _MOST:
        raise InputError(f"a GLB holds up to 4.29 GB, and {len(splats)} Gaussians take {size / 1e9:.2f} GB; export ply")
    document = _document(arrays, splats.means, size, to_recording)
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    head = _HEAD.pack(b"glTF", 2, _HEAD.size + 2 * _CHUNK.size + len(text) + size)
    blob = b"".join(array.tobytes() for array in arrays.values())
    return b"".join([head, _CHUNK.pack(len(text), b"JSON"), text, _CHUNK.pack(size, b"BIN\0"), blob])


def _attributes(splats: Activated) -> dict[str, FloatArray | IntArray]:
    """Return attribute -> [N] or [N, W], contiguous, little-endian; rows are multiples of four bytes, as glTF wants."""
    arrays: dict[str, FloatArray | IntArray] = {
        "POSITION": splats.means,
        "COLOR_0": _points(splats),
        f"{EXTENSION}:ROTATION": splats.quats,
        f"{EXTENSION}:SCALE": splats.scales,
        f"{EXTENSION}:OPACITY": splats.opacities,
    }
    for degree in range(splats.degree + 1):
        for order in range(2 * degree + 1):
            name = f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{order}"
            arrays[name] = splats.harmonics[:, degree**2 + order]
    little = {np.dtype(np.float32): "<f4", np.dtype(np.uint16): "<u2"}
    return {name: np.ascontiguousarray(array, little[array.dtype]) for name, array in arrays.items()}


def _points(splats: Activated) -> IntArray:
    """Return [N, 4] uint16: colour of degree 0 and opacity, for programs that do not know the extension.

    Colours of glTF's own attributes are linear, so the curve of sRGB is undone.
    """
    shown = np.clip(0.5 + SH0 * splats.harmonics[:, 0].astype(np.float64), 0, 1)
    linear = np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)
    points = 65535 * np.concatenate([linear, splats.opacities[:, None]], 1)
    return np.asarray(np.rint(points), np.uint16)


def _document(
    arrays: dict[str, FloatArray | IntArray], means: FloatArray, size: int, to_recording: FloatArray
) -> dict[str, Any]:
    views: list[dict[str, Any]] = []
    accessors: list[dict[str, Any]] = []
    offset = 0
    for name, array in arrays.items():
        width = "SCALAR" if array.ndim == 1 else f"VEC{array.shape[1]}"
        views.append({"buffer": 0, "byteOffset": offset, "byteLength": array.nbytes, "target": _ARRAY_BUFFER})
        accessor: dict[str, Any] = {"bufferView": len(accessors), "count": len(array), "type": width}
        accessor["componentType"] = _FLOAT if array.dtype.kind == "f" else _UNSIGNED_SHORT
        if array.dtype.kind != "f":
            accessor["normalized"] = True
        if name == "POSITION":
            accessor |= {"min": means.min(0).tolist(), "max": means.max(0).tolist()}
        accessors.append(accessor)
        offset += array.nbytes
    attributes = {name: index for index, name in enumerate(arrays)}
    primitive = {"attributes": attributes, "mode": _POINTS, "extensions": {EXTENSION: _SPLATS}}
    return {
        "asset": {"version": "2.0", "generator": "gsstream"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0], "extras": {"toRecording": to_recording.T.ravel().tolist()}}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": size}],
    }
