"""Photometric loss with its gradient: (1 - w) mean |I - G| + w (1 - mean SSIM).

SSIM is Wang et al. 2004, eq. 13, with the settings of 3D Gaussian splatting: 11x11 Gaussian window of sigma 1.5, zero
padding, C1 = 0.01^2, C2 = 0.03^2, per channel. Images are [H, W, 3] float32, normally in [0, 1].
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsstream_cpu_render import _native
from gsstream_cpu_render.arrays import (
    Float32,
    as_array,
    first_non_finite,
    lasting_array,
    native_array,
    refuse,
    refuse_value,
)

TILE = 16
"""Side of a tile, pixels."""
MOST = 1e15
"""Largest value of a target: sums of squares over a window stay finite."""


@dataclass(frozen=True)
class PreparedImage:
    """A target image with its window statistics, computed once and used in every iteration of a frame.

    Statistics are made strip by strip where they are first needed, for the rows that change are seen in few tiles.

    Raises ShapeError for a wrong shape or dtype and for a value that is not finite.
    """

    #: [H, W, 3] float32, or uint8 of which 255 is 1.0 (the same bits as its float32); it must not change while this
    #: is in use.
    image: Float32 | NDArray[np.uint8]
    #: Keep mean and root of the variance of each window as 16-bit codes, in half the memory, where the image lies in
    #: [0, 1]. A code is off by at most 1/131,070 of the mean and half of that of the root.
    compact: bool = False
    #: Mean and variance of the windows by tile [rows, columns, 2, 16, 48], as float32 or as codes, and in which strips
    #: of tiles they are known (1) already.
    statistics: tuple[NDArray[Any], NDArray[np.uint8]] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        image = as_array("target", self.image)
        in_range = image.dtype == np.uint8
        image = _image("target", image, np.uint8 if in_range else np.float32)
        if not in_range:
            # NaN is passed on by both; the statistics square what they are given.
            low, high = float(image.min()), float(image.max())
            if not max(abs(low), abs(high)) < MOST:
                refuse(first_non_finite("target", image) or "target: expected values in [0, 1], got some that overflow")
            in_range = low >= 0 and high <= 1
        rows, columns = tile_shape(*image.shape[:2])
        known = np.zeros((rows, -(-columns // _native.STRIP_TILES)), np.uint8)
        dtype = np.uint16 if self.compact and in_range else np.float32
        kept = lasting_array((rows, columns, 2, TILE, 3 * TILE), dtype)
        object.__setattr__(self, "image", image)
        object.__setattr__(self, "statistics", (kept, known))

    @property
    def handle(self) -> Any:
        """Image and statistics as the kernels take them."""
        return _native.Target(self.image, *self.statistics)


@dataclass(frozen=True)
class PhotometricLoss:
    """Loss and gradient of one image.

    ``value`` = (1 - w) ``l1`` + w ``dssim``; ``l1`` and ``dssim`` are sums over active pixels and channels of |I - G|
    and 1 - SSIM, divided by 3 H W. ``gradient`` [H, W, 3] is d value / d image, or None if it was not asked for.
    """

    value: float
    l1: float
    dssim: float
    gradient: Float32 | None


def tile_shape(height: int, width: int) -> tuple[int, int]:
    """Tile rows and columns of an image; partial tiles at the right and bottom count."""
    return -(-height // TILE), -(-width // TILE)


def photometric_loss(
    image: Any,
    target: Any,
    *,
    dssim_weight: float = 0.2,
    tile_mask: Any | None = None,
    gradient: bool = True,
    around: bool = False,
    out: Float32 | None = None,
) -> PhotometricLoss:
    """Evaluate the loss over all pixels, or over the pixels of active tiles.

    Args:
        image: [H, W, 3] float32. With a mask, pixels up to 5 beyond active tiles are read too (SSIM windows), so the
            inactive part must hold the rest of the picture, for instance the cached render of the previous frame.
        target: [H, W, 3] float32 or uint8, or a PreparedImage, which saves blurring it again.
        dssim_weight: w in [0, 1].
        tile_mask: [ceil(H/16), ceil(W/16)] bool or uint8; None means all tiles. The sums are divided by 3 H W as in
            the dense loss, so that losses of disjoint masks add up to it.
        gradient: compute the gradient. In inactive tiles it is left as it is in ``out`` (zero without ``out``).
        around: sum also over the tiles beside masked ones, whose windows see them; the gradient is written in masked
            tiles alone and is there that of the dense loss.
        out: [H, W, 3] float32 to write the gradient into, if given.

    Raises:
        ShapeError: wrong shape, dtype, memory layout, or a value that is not finite.
        InputError: dssim_weight outside [0, 1].
    """
    if not 0.0 <= dssim_weight <= 1.0:
        refuse_value(f"dssim_weight: expected a number in [0, 1], got {dssim_weight!r}")
    image = _image("image", image)
    known = target if isinstance(target, PreparedImage) else None
    goal = as_array("target", target if known is None else known.image)
    goal = native_array("target", goal, np.uint8 if goal.dtype == np.uint8 else np.float32, image.shape)
    height, width, _ = image.shape
    wanted = _mask(tile_mask, height, width)
    # Without a mask there is nothing beside, and the kernel takes the whole image in one go.
    active = _dilated(wanted) if around and tile_mask is not None else wanted
    if not gradient:
        result = None
    elif out is None:
        result = np.zeros_like(image)
    else:
        result = native_array("out", out, np.float32, image.shape, writable=True)
    scale = 1.0 / image.size
    handle = _native.Target(goal) if known is None else known.handle
    l1, dssim = _native.photometric_evaluate(
        image, handle, active, wanted, result, (1.0 - dssim_weight) * scale, -dssim_weight * scale
    )
    if not np.isfinite(l1 + dssim):
        refuse(
            first_non_finite("image", image)
            or first_non_finite("target", goal)
            or "image: expected values in [0, 1], got some so large that the loss overflows"
        )
    return PhotometricLoss(weighted(l1, dssim, dssim_weight, scale), l1 * scale, dssim * scale, result)


def weighted(l1: float, dssim: float, dssim_weight: float, scale: float) -> float:
    """The loss of sums of |I - G| and of 1 - SSIM, both times ``scale``."""
    return float((1.0 - dssim_weight) * (l1 * scale) + dssim_weight * (dssim * scale))


def _image(name: str, value: Any, dtype: type[np.generic] = np.float32) -> NDArray[Any]:
    array = native_array(name, value, dtype, ("H", "W", 3))
    if array.size == 0:
        refuse(f"{name}: expected at least one pixel, got shape {list(array.shape)}")
    return array


def _mask(mask: Any | None, height: int, width: int) -> NDArray[np.uint8]:
    shape = tile_shape(height, width)
    if mask is None:
        return np.ones(shape, dtype=np.uint8)
    boolean = str(getattr(mask, "dtype", "")) in ("bool", "torch.bool")
    array = native_array("tile_mask", mask, np.bool_ if boolean else np.uint8, shape)
    return array.view(np.uint8)


def _dilated(mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
    rows, columns = mask.shape
    padded = np.pad(mask, 1)
    shifts = [padded[y : y + rows, x : x + columns] for y in range(3) for x in range(3)]
    return np.ascontiguousarray(np.maximum.reduce(shifts))
