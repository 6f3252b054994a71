"""One pinhole camera as the kernels want it, checked. Imports no torch."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from gsstream_cpu_render.arrays import Float32, refuse, refuse_value

Background = tuple[float, float, float]
NEAR = 0.01
MAX_PIXELS = 65536


class View(NamedTuple):
    """Fields in the order of the native call; see NumpyRasterizer for their meaning."""

    viewmat: Float32
    K: Float32
    width: int
    height: int
    near: float
    background: Float32


def checked_view(
    viewmat: ArrayLike, K: ArrayLike, width: int, height: int, background: Background, near: float
) -> View:
    """A View of these values.

    Raises:
        InputError: matrices of wrong shape or not finite, skew, a focal length or near plane that is not positive, an
            empty or huge image.
    """
    view = View(
        viewmat=_matrix("viewmat", viewmat, 4),
        K=_matrix("K", K, 3),
        width=int(width),
        height=int(height),
        near=float(near),
        background=np.asarray(background, np.float32),
    )
    fx, fy, skew = view.K[0, 0], view.K[1, 1], view.K[0, 1]
    if not (fx > 0 and fy > 0):
        refuse_value(f"K: expected positive focal lengths in pixels, got fx = {fx:g}, fy = {fy:g}")
    if skew != 0:
        refuse_value(f"K: expected no skew (K[0, 1] = 0), got {skew:g}; undistort the images first")
    if not (1 <= width <= MAX_PIXELS and 1 <= height <= MAX_PIXELS):
        refuse_value(f"image size: expected 1 to {MAX_PIXELS} pixels a side, got {width} x {height}")
    if not 0 < near < np.inf:
        refuse_value(f"near: expected a positive distance in scene units, got {near}")
    if view.background.shape != (3,) or not np.isfinite(view.background).all():
        refuse_value(f"background: expected three finite numbers, got {background!r}")
    return view


def _matrix(name: str, value: ArrayLike, side: int) -> Float32:
    matrix = np.ascontiguousarray(value, np.float32)
    if matrix.shape != (side, side):
        refuse(f"{name}: expected shape [{side}, {side}], got {list(matrix.shape)}")
    if not np.isfinite(matrix).all():
        refuse(f"{name}: expected finite values, got {matrix.tolist()}")
    return matrix
