"""3DGS PLY files: one scene in the file format that viewers and editors of Gaussian splats read."""

from __future__ import annotations

import os
from collections.abc import Sequence

import numpy as np

from gsstream.core.gaussians import Gaussians
from gsstream.core.shapes import FloatArray


def ply_properties(sh_rest: int) -> list[str]:
    """Return the names of the float32 properties of a scene with K - 1 = ``sh_rest`` higher coefficients.

    They stand in the order of the file.

    Names, order and conventions are those that the 3D Gaussian Splatting release writes: view-dependent colour channel
    by channel, opacity as logit, scales as logarithm, quaternion wxyz, normals all zero.
    """
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(3 * sh_rest)]
    return [*names, "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]


def ply_bytes(gaussians: Gaussians[FloatArray], comments: Sequence[str] = ()) -> bytes:
    """Return a binary little-endian PLY of raw (pre-activation) values.

    Arguments:
        gaussians: N rows.
        comments: lines for its header.
    """
    number, rest = len(gaussians), gaussians.shN.shape[1]
    names = ply_properties(rest)
    head = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    head += [f"element vertex {number}"]
    head += [*(f"property float {name}" for name in names), "end_header\n"]
    columns = [
        gaussians.means, np.zeros((number, 3)), gaussians.sh0.reshape(number, 3),
        # [N, K - 1, 3] -> channel by channel: all of red, then green, then blue.
        gaussians.shN.transpose(0, 2, 1).reshape(number, 3 * rest),
        gaussians.opacities[:, None], gaussians.scales, gaussians.quats,
    ]  # fmt: skip
    return "\n".join(head).encode("ascii") + np.concatenate(columns, 1).astype("<f4").tobytes()


def write_ply(path: str | os.PathLike[str], gaussians: Gaussians[FloatArray], comments: Sequence[str] = ()) -> None:
    """Write :func:`ply_bytes` to a file.

    Arguments:
        path: of the file.
        gaussians: N rows.
        comments: lines for its header.
    """
    with open(path, "wb") as file:
        file.write(ply_bytes(gaussians, comments))
