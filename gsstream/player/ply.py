"""3DGS PLY files: one scene in the file format that viewers and editors of Gaussian splats read."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gsstream.core.errors import InputError
from gsstream.core.gaussians import Gaussians
from gsstream.core.shapes import FloatArray


def ply_properties(sh_rest: int) -> list[str]:
    """Return the names, as in the 3DGS release, of the float32 properties of a scene with ``sh_rest`` coefficients."""
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(3 * sh_rest)]
    return [*names, "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]


def ply_bytes(gaussians: Gaussians[FloatArray], comments: Sequence[str] = ()) -> bytes:
    """Return a binary little-endian PLY of raw (pre-activation) values."""
    number, rest = len(gaussians), gaussians.shN.shape[1]
    names = ply_properties(rest)
    head = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    head += [f"element vertex {number}"]
    head += [*(f"property float {name}" for name in names), "end_header\n"]
    columns = [
        gaussians.means,
        np.zeros((number, 3)),
        gaussians.sh0.reshape(number, 3),
        # [N, K - 1, 3] -> channel by channel: all of red, then green, then blue.
        gaussians.shN.transpose(0, 2, 1).reshape(number, 3 * rest),
        gaussians.opacities[:, None],
        gaussians.scales,
        gaussians.quats,
    ]
    return "\n".join(head).encode("ascii") + np.concatenate(columns, 1).astype("<f4").tobytes()


def write_ply(path: str | os.PathLike[str], gaussians: Gaussians[FloatArray], comments: Sequence[str] = ()) -> None:
    """Write :func:`ply_bytes` to a file."""
    with open(path, "wb") as file:
        file.write(ply_bytes(gaussians, comments))


def read_ply(path: str | os.PathLike[str]) -> tuple[Gaussians[FloatArray], tuple[float, float, float]]:
    """Read a binary 3DGS PLY: (raw values, float32; the offset that a comment of its header states, else zeros).

    Properties may stand in any order; others than those of the release are passed over.

    Raises InputError for a file that is not such a PLY, naming what is missing.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from error
    head, end, body = data.partition(b"end_header\n")
    lines = [line.strip() for line in head.decode("ascii", "replace").split("\n")]
    if not end or lines[0] != "ply" or "format binary_little_endian 1.0" not in lines:
        raise InputError(f"{path}: expected a PLY with the line 'format binary_little_endian 1.0'")
    number, names, offset = _header(path, lines)
    dtype = np.dtype([(name, kind) for name, kind in names])
    if len(body) < number * dtype.itemsize:
        raise InputError(f"{path}: expected {number * dtype.itemsize} bytes of vertices, got {len(body)}")
    table = np.frombuffer(body, dtype, number)
    rest = sum(name.startswith("f_rest_") for name, _ in names)
    needed = [name for name in ply_properties(rest // 3) if name not in ("nx", "ny", "nz")]
    missing = [name for name in needed if name not in (dtype.names or ())]
    if missing or rest not in (0, 9, 24, 45):
        raise InputError(f"{path}: expected the properties of 3DGS; missing {', '.join(missing) or 'some of f_rest_*'}")

    def columns(*wanted: str) -> FloatArray:
        values = np.stack([table[name] for name in wanted], 1) if wanted else np.zeros((number, 0))
        return np.ascontiguousarray(values, np.float32)

    gaussians = Gaussians(
        means=columns("x", "y", "z"),
        quats=columns(*(f"rot_{i}" for i in range(4))),
        scales=columns(*(f"scale_{i}" for i in range(3))),
        opacities=columns("opacity")[:, 0],
        sh0=columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None],
        shN=columns(*(f"f_rest_{i}" for i in range(rest))).reshape(number, 3, rest // 3).transpose(0, 2, 1).copy(),
    )
    return gaussians, offset


#: Types of properties, as PLY names them.
_TYPES = {
    "float": "<f4", "float32": "<f4", "double": "<f8", "float64": "<f8", "uchar": "u1", "uint8": "u1", "char": "i1",
    "int8": "i1", "ushort": "<u2", "uint16": "<u2", "short": "<i2", "int16": "<i2", "uint": "<u4", "uint32": "<u4",
    "int": "<i4", "int32": "<i4",
}  # fmt: skip


def _header(
    path: str | os.PathLike[str], lines: Sequence[str]
) -> tuple[int, list[tuple[str, str]], tuple[float, float, float]]:
    """Number of vertices, their properties with types, offset."""
    number, names, offset = 0, list[tuple[str, str]](), (0.0, 0.0, 0.0)
    words = [line.split() for line in lines]
    elements = [word[1:] for word in words if word[:1] == ["element"]]
    try:
        if len(elements) != 1 or elements[0][0] != "vertex":
            raise ValueError("one element, vertex")
        number = int(elements[0][1])
        names = [(word[2], _TYPES[word[1]]) for word in words if word[:1] == ["property"]]
        for word in words:
            if word[:2] == ["comment", "offset"]:
                x, y, z = map(float, word[2:])
                offset = (x, y, z)
        if number < 0 or len(dict(names)) < len(names):
            raise ValueError("a number of vertices, and each property once")
    except (ValueError, KeyError, IndexError) as error:
        raise InputError(f"{path}: its header is not that of a 3DGS PLY: {error!r}") from error
    return number, names, offset
