"""Extra metrics by name, for evaluations and sweeps."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

from gsstream.core.errors import UnknownName
from gsstream.evaluation.evaluate import ViewMetric, ViewPair
from gsstream.metrics import FLIP_VARIANT, MS_SSIM_VARIANT, flicker, flip, ms_ssim

#: Least side of an image for MS-SSIM, in pixels: its coarsest scale must be as large as a window.
_MS_SSIM_SIDE = 176


def _ms_ssim(pair: ViewPair) -> float:
    return ms_ssim(pair.image, pair.truth) if min(pair.image.shape[:2]) >= _MS_SSIM_SIDE else math.nan


def _flip(pair: ViewPair) -> float:
    return flip(pair.image, pair.truth)


def _flicker(pair: ViewPair) -> float:
    if pair.last_image is None or pair.last_truth is None:
        return math.nan
    return flicker(pair.image, pair.last_image, pair.truth, last_truth=pair.last_truth, sigma=pair.sigma)


EXTRAS: Mapping[str, ViewMetric] = {"ms_ssim": _ms_ssim, "flip": _flip, "flicker": _flicker}
VARIANTS: Mapping[str, str] = {
    "ms_ssim": f"{MS_SSIM_VARIANT}; not defined below {_MS_SSIM_SIDE} pixels",
    "flip": FLIP_VARIANT,
    "flicker": "mean absolute change of still pixels between decoded frames, levels of 8 bits",
}


def extras(names: Iterable[str]) -> dict[str, ViewMetric]:
    """Return the named metrics. Raises UnknownName, naming the nearest."""
    out = {}
    for name in names:
        if name not in EXTRAS:
            raise UnknownName("extra metric", name, EXTRAS)
        out[name] = EXTRAS[name]
    return out
