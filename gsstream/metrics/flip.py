"""FLIP: the difference a person sees when two pictures alternate (Andersson et al. 2020), by its authors' own code."""

from __future__ import annotations

import numpy as np

from gsstream.core.errors import PluginUnavailable
from gsstream.core.install_hints import install_extra
from gsstream.core.shapes import FloatArray
from gsstream.metrics.picture_quality import check_pair

FLIP_VARIANT = "LDR-FLIP, 67 pixels per degree, mean (flip-evaluator)"
_PIXELS_PER_DEGREE = 67.0206


def flip(image: FloatArray, target: FloatArray) -> float:
    """Return the mean LDR-FLIP, 0 to 1, of two [H, W, 3] images in [0, 1], sRGB as recorded.

    Raises PluginUnavailable without the package flip-evaluator (extra: metrics), ShapeError when shapes disagree.
    """
    check_pair(image, target)
    try:
        from flip_evaluator import evaluate
    except ImportError as error:
        raise PluginUnavailable(f"FLIP needs the package flip-evaluator: {install_extra('metrics')}") from error
    pair = (np.ascontiguousarray(target, np.float32), np.ascontiguousarray(image, np.float32))
    _, mean, _ = evaluate(
        *pair, "LDR", inputsRGB=True, applyMagma=False, computeMeanError=True, parameters={"ppd": _PIXELS_PER_DEGREE}
    )
    return float(mean)
