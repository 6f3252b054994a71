"""A slow forward rasteriser in plain numpy, tile by tile: the player's renderer where no compiled one is installed.

Same conventions as gsstream/parts/render (which needs torch): pixel-corner origin, 0.3 px blur, alpha cut 1/255, alpha
clamp 0.999, a Gaussian counts while the transmittance before it exceeds 1e-4, nothing at or before the near plane. A
test holds the two together.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from gsstream.core.changes.motion import quat_to_rotmat
from gsstream.core.harmonics import sh_basis
from gsstream.core.shapes import FloatArray, IntArray

BLUR, ALPHA_CUT, ALPHA_MAX, TRANSMITTANCE_MIN = 0.3, 1 / 255, 0.999, 1e-4
TILE = 16
#: Bytes at the peak for every pair of a splat and a tile, and for every splat and pixel of the tile that is drawn.
PAIR_BYTES, CELL_BYTES = 64, 64


def render_numpy(
    arrays: Sequence[FloatArray],
    viewmat: FloatArray,
    K: FloatArray,
    width: int,
    height: int,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    near: float = 0.01,
    max_memory: int | None = None,
) -> FloatArray:
    """Render raw Gaussians (means, quats, scales, opacities, sh0, shN) for one camera: [height, width, 3] float32.

    Raises MemoryError when pairs of Gaussians and tiles, and what one tile needs, would take more than ``max_memory``
    bytes; both are counted before they are made.
    """
    means, quats, scales, opacities, sh0, shN = arrays
    viewmat, K = np.asarray(viewmat, np.float64), np.asarray(K, np.float64)
    center = -viewmat[:3, :3].T @ viewmat[:3, 3]
    points = means.astype(np.float64) @ viewmat[:3, :3].T + viewmat[:3, 3]
    front = np.flatnonzero(points[:, 2] > near)
    front = front[np.argsort(points[front, 2], kind="stable")]
    means2d, covariance = _project(
        points[front], quats[front], scales[front], viewmat=viewmat, K=K, width=width, height=height
    )
    with np.errstate(over="ignore"):
        opacity = 1 / (1 + np.exp(-opacities[front].astype(np.float64)))
    colors = _colors(sh0[front], shN[front], means[front].astype(np.float64) - center)
    image = np.empty((height, width, 3), np.float32)
    image[:] = background
    table = np.column_stack([means2d, _conics(covariance), opacity, colors])
    low, span = _tile_boxes(means2d, covariance, opacity, width=width, height=height)
    if max_memory is not None:
        _check_memory(low, span, -(-width // TILE), -(-height // TILE), max_memory=max_memory)
    rows, tiles = _tile_lists(low, span, -(-width // TILE))
    columns = -(-width // TILE)
    starts = np.flatnonzero(np.diff(tiles, prepend=-1))
    # With no pair at all `starts` is empty and the background stays.
    for start, stop in zip(starts, [*starts[1:], len(tiles)], strict=False):
        y, x = divmod(int(tiles[start]), columns)
        window = (slice(y * TILE, min((y + 1) * TILE, height)), slice(x * TILE, min((x + 1) * TILE, width)))
        image[window] = _composite(table[rows[start:stop]], window, background)
    return image


def _project(
    points: FloatArray,
    quats: FloatArray,
    scales: FloatArray,
    viewmat: FloatArray,
    K: FloatArray,
    width: int,
    height: int,
) -> tuple[FloatArray, FloatArray]:
    """Means2d [N, 2] px and blurred covariances [N, 3] (xx, xy, yy) px^2 (EWA splatting, Zwicker et al. 2001)."""
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    x, y, depth = points.T
    means2d = np.stack([fx * x / depth + cx, fy * y / depth + cy], -1)
    margin_x, margin_y = 0.15 * width / fx, 0.15 * height / fy
    tx = np.clip(x / depth, -cx / fx - margin_x, (width - cx) / fx + margin_x)
    ty = np.clip(y / depth, -cy / fy - margin_y, (height - cy) / fy + margin_y)
    zero = np.zeros_like(depth)
    jacobian = np.stack([fx / depth, zero, -fx * tx / depth, zero, fy / depth, -fy * ty / depth], -1).reshape(-1, 2, 3)
    axes = rotation_matrices(quats.astype(np.float64)) * np.exp(scales.astype(np.float64))[:, None, :]
    footprint = jacobian @ (viewmat[:3, :3] @ axes)
    full = footprint @ footprint.transpose(0, 2, 1)
    return means2d, np.stack([full[:, 0, 0] + BLUR, full[:, 0, 1], full[:, 1, 1] + BLUR], -1)


def rotation_matrices(quats: FloatArray) -> FloatArray:
    """Return the rotations [N, 3, 3] of [N, 4] quaternions wxyz of any norm."""
    return quat_to_rotmat(quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-10))


def _conics(covariance: FloatArray) -> FloatArray:
    a, b, c = covariance.T
    return np.asarray(np.stack([c, -b, a], -1) / (a * c - b * b)[:, None])


def _colors(sh0: FloatArray, shN: FloatArray, directions: FloatArray) -> FloatArray:
    """[N, 3] view-dependent colour, clamped at 0."""
    unit = directions / np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-10)
    basis = sh_basis(unit, round((shN.shape[1] + 1) ** 0.5) - 1)
    coefficients = np.concatenate([sh0, shN], 1).astype(np.float64)
    return np.asarray(np.maximum(np.einsum("kn,nkc->nc", basis, coefficients) + 0.5, 0.0))


def _tile_boxes(
    means2d: FloatArray, covariance: FloatArray, opacity: FloatArray, width: int, height: int
) -> tuple[IntArray, IntArray]:
    """First tile and number of tiles [N, 2] (x, y) of every splat. It reaches as far as its alpha exceeds the cut."""
    reach2 = 2 * np.log(np.maximum(opacity / ALPHA_CUT, 1.0))
    # The tiny margin keeps pixels whose alpha equals the cut up to rounding.
    half = np.sqrt(reach2[:, None] * covariance[:, [0, 2]]) + 1e-6
    limit = np.array([-(-width // TILE), -(-height // TILE)])
    with np.errstate(invalid="ignore"):
        low = np.clip(np.floor((means2d - half) / TILE), 0, limit).astype(np.int64)
        high = np.clip(np.floor((means2d + half) / TILE) + 1, 0, limit).astype(np.int64)
    return low, np.where((opacity >= ALPHA_CUT)[:, None], np.maximum(high - low, 0), 0)


def _check_memory(low: IntArray, span: IntArray, columns: int, lines: int, max_memory: int) -> None:
    """Raise MemoryError where the pairs, or the splats of the fullest tile, take too much."""
    pairs = int((span[:, 0] * span[:, 1]).sum())
    corners = np.zeros((lines + 1, columns + 1), np.int64)  # their sums from the first corner on count splats by tile
    high = low + span
    for sign, ys, xs in ((1, low, low), (-1, low, high), (-1, high, low), (1, high, high)):
        np.add.at(corners, (ys[:, 1], xs[:, 0]), sign)
    fullest = int(corners.cumsum(0).cumsum(1).max())
    wanted = max(pairs * PAIR_BYTES, fullest * TILE * TILE * CELL_BYTES)
    if wanted > max_memory:
        raise MemoryError(
            f"{pairs} pairs of Gaussians and tiles, {fullest} of them in one tile, about {wanted / 1e6:,.0f} MB where "
            f"{max_memory / 1e6:,.0f} MB are allowed"
        )


def _tile_lists(low: IntArray, span: IntArray, columns: int) -> tuple[IntArray, IntArray]:
    """(splat, tile) pairs, tile by tile, splats in depth order."""
    number = span[:, 0] * span[:, 1]
    rows = np.repeat(np.arange(len(number)), number)
    inside = np.arange(len(rows)) - np.repeat(np.cumsum(number) - number, number)
    tile = (low[rows, 1] + inside // np.maximum(span[rows, 0], 1)) * columns
    tile += low[rows, 0] + inside % np.maximum(span[rows, 0], 1)
    order = np.argsort(tile, kind="stable")
    return rows[order], tile[order]


def _composite(splats: FloatArray, window: tuple[slice, slice], background: tuple[float, float, float]) -> FloatArray:
    ys, xs = (np.arange(s.start, s.stop) + 0.5 for s in window)
    shape = (len(ys), len(xs))
    dx = np.tile(xs, shape[0])[None] - splats[:, 0:1]
    dy = np.repeat(ys, shape[1])[None] - splats[:, 1:2]
    a, b, c, opacity = splats[:, 2:3], splats[:, 3:4], splats[:, 4:5], splats[:, 5:6]
    alpha = np.minimum(opacity * np.exp(-(0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy)), ALPHA_MAX)
    alpha[alpha < ALPHA_CUT] = 0
    # Transmittance only falls, so "stop after it drops below the minimum" equals masking what comes later.
    before = np.cumprod(np.concatenate([np.ones((1, alpha.shape[1])), 1 - alpha]), 0)
    stopped = before[:-1] <= TRANSMITTANCE_MIN
    alpha[stopped] = 0
    first_stop = np.where(stopped.any(0), stopped.argmax(0), len(splats))
    left = before[first_stop, np.arange(alpha.shape[1])]
    color = np.einsum("np,nc->pc", alpha * before[:-1], splats[:, 6:9]) + left[:, None] * np.asarray(background)
    return np.asarray(color.reshape(*shape, 3), np.float32)
