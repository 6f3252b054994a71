"""How near a picture comes to another: PSNR and SSIM, on all pixels, on those that moved and on those that changed."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Literal, NamedTuple

import numpy as np

from gsstream.core.errors import ShapeError
from gsstream.core.shapes import BoolArray, FloatArray

Mask = np.ndarray[tuple[int, ...], np.dtype[np.bool_]]
#: Printed in every table: SSIM variants differ by up to 0.02.
SSIM_VARIANT = "SSIM 11x11 Gaussian 1.5, zero padding, mean over channels (3DGS)"
MS_SSIM_VARIANT = "MS-SSIM 5 scales, 11x11 Gaussian 1.5, valid region, mean over channels (Wang 2003)"
_RADIUS, _SIGMA, _C1, _C2 = 5, 1.5, 0.01**2, 0.03**2
#: What stands beyond the border: zeros (3DGS), the mirrored image (kornia, torchmetrics), or nothing: only windows
#: inside the image count (Wang's own code, scikit-image, pytorch-msssim).
Border = Literal["zero", "reflect", "valid"]
#: Rows of a picture that are compared at a time.
_BAND = 64
#: Exponents of the scales, finest first (Wang, Simoncelli, Bovik 2003).
_SCALES = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)


def psnr(image: FloatArray, target: FloatArray, mask: Mask | None = None) -> float:
    """Return -10 log10 of the mean squared error of one image, dB; inf for equal ones, nan for an empty mask."""
    check_pair(image, target)
    error: FloatArray = np.subtract(image, target, dtype=np.float64)
    np.square(error, out=error)
    if mask is not None:
        if mask.shape != error.shape[:2]:
            raise ShapeError(f"mask: expected {list(error.shape[:2])}, got {list(mask.shape)}")
        error = error[mask]
    if error.size == 0:
        return math.nan
    mean = float(error.mean())
    return math.inf if mean == 0 else -10 * math.log10(mean)


def check_pair(image: FloatArray, target: FloatArray) -> None:
    """Raise ShapeError unless both are [H, W, 3] of one size."""
    if image.shape != target.shape or image.ndim != 3 or image.shape[2] != 3:
        raise ShapeError(f"expected two [H, W, 3] images of one size, got {list(image.shape)} and {list(target.shape)}")


def ssim(image: FloatArray, target: FloatArray, border: Border = "zero") -> float:
    """Return the mean SSIM of two [H, W, 3] images in [0, 1] (Wang et al. 2004), padded as in 3DGS by default.

    Computed in float64. Raises ShapeError when shapes disagree, or are smaller than a window where one must fit.
    """
    check_pair(image, target)
    _check_fits(image, border)
    total = sum(float(band.sum()) for band in _ssim_by_bands(image, target, border))
    lost = 2 * _RADIUS if border == "valid" else 0
    return float(total / (3 * (image.shape[0] - lost) * (image.shape[1] - lost)))


def ms_ssim(image: FloatArray, target: FloatArray) -> float:
    """Return the multi-scale SSIM of two [H, W, 3] images in [0, 1] (Wang, Simoncelli, Bovik 2003), in float64.

    Five scales by the mean of 2 x 2 pixels, a last odd row or column left out; negative structure counts as 0. Raises
    ShapeError when shapes disagree or a side is below 176 pixels: the coarsest scale must hold a window.
    """
    check_pair(image, target)
    least = (2 * _RADIUS + 1) << (len(_SCALES) - 1)
    if min(image.shape[:2]) < least:
        raise ShapeError(f"MS-SSIM: expected sides of at least {least} pixels, got {list(image.shape[:2])}")
    x: FloatArray = np.asarray(image, np.float64)
    y: FloatArray = np.asarray(target, np.float64)
    value: FloatArray = np.ones(3)
    for scale, exponent in enumerate(_SCALES):
        luminance, structure = _ssim_maps(x, y, "valid")
        last = scale == len(_SCALES) - 1
        term = (luminance * structure if last else structure).mean((0, 1))
        value = value * np.maximum(term, 0) ** exponent
        x, y = _halve(x), _halve(y)
    return float(value.mean())


def _ssim_by_bands(image: FloatArray, target: FloatArray, border: Border) -> Iterator[FloatArray]:
    """SSIM pixel by pixel, some rows of one channel at a time.

    The maps of a whole large picture take hundreds of megabytes; those of a band stay in the processor's cache.
    """
    inside = border == "valid"
    for top in range(0, len(image) - 2 * _RADIUS * inside, _BAND):
        first = top if inside else max(0, top - _RADIUS)
        rows = slice(first, top + _BAND + (2 * _RADIUS if inside else _RADIUS))
        # Windows that reach beyond the band, but not beyond the picture, are cut off again.
        wanted = slice(top - first, top - first + _BAND)
        for channel in range(image.shape[2]):
            luminance, structure = _ssim_maps(image[rows, :, [channel]], target[rows, :, [channel]], border)
            yield (luminance * structure)[wanted]


def _check_fits(image: FloatArray, border: Border) -> None:
    if border != "zero" and min(image.shape[:2]) <= 2 * _RADIUS:
        got = list(image.shape[:2])
        raise ShapeError(f"SSIM with border {border!r}: expected sides above {2 * _RADIUS}, got {got}")


def _ssim_maps(image: FloatArray, target: FloatArray, border: Border) -> tuple[FloatArray, FloatArray]:
    """The two factors of SSIM, pixel by pixel: (luminance, contrast and structure)."""
    x, y = np.asarray(image, np.float64), np.asarray(target, np.float64)
    mean_x, mean_y, square_x, square_y, product = (_window_mean(v, border) for v in (x, y, x * x, y * y, x * y))
    var_x, var_y, cov = square_x - mean_x**2, square_y - mean_y**2, product - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + _C1) / (mean_x**2 + mean_y**2 + _C1)
    return luminance, (2 * cov + _C2) / (var_x + var_y + _C2)


def _window_mean(image: FloatArray, border: Border) -> FloatArray:
    if border == "zero":
        return _blur(image)
    if border == "reflect":
        image = np.pad(image, [(_RADIUS, _RADIUS), (_RADIUS, _RADIUS), (0, 0)], mode="reflect")
    return _blur(image)[_RADIUS:-_RADIUS, _RADIUS:-_RADIUS]


def _halve(image: FloatArray) -> FloatArray:
    height, width = (size // 2 * 2 for size in image.shape[:2])
    even = image[:height, :width]
    return (even[::2, ::2] + even[1::2, ::2] + even[::2, 1::2] + even[1::2, 1::2]) / 4


def _blur(image: FloatArray) -> FloatArray:
    taps = np.exp(-(np.arange(_RADIUS + 1) ** 2) / (2 * _SIGMA**2))
    taps /= taps[0] + 2 * taps[1:].sum()
    for axis in (0, 1):
        padding = [(0, 0)] * 3
        padding[axis] = (_RADIUS, _RADIUS)
        wide, size = np.pad(image, padding), image.shape[axis]
        out = taps[0] * image
        for i in range(1, _RADIUS + 1):
            pair = _window(wide, axis, _RADIUS - i, size) + _window(wide, axis, _RADIUS + i, size)
            pair *= taps[i]
            out += pair
        image = out
    return image


def _window(image: FloatArray, axis: int, start: int, size: int) -> FloatArray:
    return image[start : start + size] if axis == 0 else image[:, start : start + size]


class PictureQuality(NamedTuple):
    """Qualities of one picture; PSNR in dB, nan where a mask holds no pixel."""

    psnr: float
    ssim: float
    psnr_moving: float
    psnr_changed: float


def picture_quality(image: FloatArray, truth: FloatArray, moving: BoolArray, *, changed: BoolArray) -> PictureQuality:
    """Compare an image [H, W, 3] in [0, 1] with the recorded one.

    Arguments:
        image, truth: [H, W, 3] in [0, 1].
        moving, changed: [H, W] bool, pixels of :func:`moving_mask` and of :func:`changed_mask`.
    """
    return PictureQuality(
        psnr(image, truth), ssim(image, truth), psnr(image, truth, moving), psnr(image, truth, changed)
    )
