"""3DGS PLY files: one scene in the file format that viewers and editors of Gaussian splats read."""

from __future__ import annotations

import os
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from gsstream.core.errors import InputError
from gsstream.core.gaussians import Gaussians
from gsstream.core.shapes import FloatArray
from gsstream.core.vertices import read_vertices

#: Logit of an opacity of 1 - 2e-9, which no renderer tells from 1.
MOST_OPAQUE = 20.0


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

    Properties and elements may stand in any order; others than those of the release are passed over. Opacities of
    infinity, which some programs write for a splat that covers all behind it, become logits of 20,
    an opacity of 1 - 2e-9; a warning says how many.

    Raises InputError for a file that is not such a PLY, naming what is missing, and for values that are not finite.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from error
    try:
        found = read_vertices(data)
        offset = _offset(found.comments)
    except ValueError as error:
        raise InputError(f"{path}: {error}") from error
    table, names = found.table, found.table.dtype.names or ()
    rest = sum(name.startswith("f_rest_") for name in names)
    needed = [name for name in ply_properties(rest // 3) if name not in ("nx", "ny", "nz")]
    missing = [name for name in needed if name not in names]
    if missing or rest not in (0, 9, 24, 45):
        raise InputError(f"{path}: expected the properties of 3DGS; missing {', '.join(missing) or 'some of f_rest_*'}")

    def columns(*wanted: str) -> FloatArray:
        values = np.stack([table[name] for name in wanted], 1) if wanted else np.zeros((len(table), 0))
        return np.ascontiguousarray(values, np.float32)

    gaussians = Gaussians(
        means=columns("x", "y", "z"),
        quats=columns(*(f"rot_{i}" for i in range(4))),
        scales=columns(*(f"scale_{i}" for i in range(3))),
        opacities=_bounded(path, columns("opacity")[:, 0]),
        sh0=columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None],
        shN=columns(*(f"f_rest_{i}" for i in range(rest))).reshape(len(table), 3, rest // 3).transpose(0, 2, 1).copy(),
    )
    for name, values in gaussians.items():
        bad = ~np.isfinite(values).all(axis=tuple(range(1, values.ndim)))
        if name == "quats":
            bad |= ~values.any(1)
        if bad.any():
            row = int(bad.argmax())
            raise InputError(
                f"{path}: vertex {row}: {name} are {values[row].ravel()[:4].tolist()}, expected finite values"
                f"{' that are not all zero' if name == 'quats' else ''} ({int(bad.sum())} such vertices)"
            )
    return gaussians, offset


def _bounded(path: str | os.PathLike[str], opacities: FloatArray) -> FloatArray:
    """Logits of opacity [N], those of exactly 1 and exactly 0 as near to them as any picture shows."""
    if number := int(np.isinf(opacities).sum()):
        message = (
            f"{path}: {number} opacities are infinite (opacity of exactly 1 or 0); they are read as {MOST_OPAQUE:g}"
        )
        warnings.warn(message, stacklevel=3)
    return np.where(np.isinf(opacities), np.copysign(np.float32(MOST_OPAQUE), opacities), opacities)


def _offset(comments: Sequence[Sequence[str]]) -> tuple[float, float, float]:
    """The offset that a comment of ours states, else zeros. Raises ValueError for one that is not three numbers."""
    stated = next((words[1:] for words in comments if words[:1] == ("offset",)), ("0", "0", "0"))
    x, y, z = map(float, stated)
    if not np.isfinite((x, y, z)).all():
        raise ValueError(f"its header has the offset {x:g} {y:g} {z:g}; expected finite numbers")
    return x, y, z
