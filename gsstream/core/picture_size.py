"""What settings that are given for small pictures become in larger ones, so that a recipe fits every size.

Lengths in pixels, the price of a bit and the thresholds of growth are chosen on pictures 320 pixels wide. A wider
picture of the same scene shows everything larger and more of its detail, so each setting follows the width by a rule of
its own; narrower pictures keep the setting as it is. The exponents are ours, fitted to runs at widths of 320, 640, 676
and 1352 (docs/results/extremes.md).
"""

from __future__ import annotations

import math

#: Width, and number of pixels, of the pictures for which settings are given.
WIDTH, PIXELS = 320, 320 * 240
#: Width from which a picture is large: what lies away from a change is then told without its pixels, and what a loss
#: keeps of its target may be rounded to 16 bits.
LARGE = 960


def is_large(width: int) -> bool:
    """Return whether a picture is so large that memory and time count for more than its last digits."""
    return width >= LARGE


def enlargement(width: int) -> float:
    """Return how many times wider than 320 pixels a picture is, at least 1: the factor on lengths in pixels."""
    return max(1.0, width / WIDTH)


def bit_price_factor(pixels: int) -> float:
    """Return the factor on the price of a bit, which is divided by the pixels of a view.

    Without it a bit would become cheaper as fast as pixels become more, though what moves is not seen better for it.
    """
    return math.pow(max(1.0, pixels / PIXELS), 0.75)


def densify_factor(width: int) -> float:
    """Return the factor on the mean screen gradient, in half image widths, above which a Gaussian is densified.

    A Gaussian of a given number of pixels has a smaller part in the mean over a larger picture.
    """
    return math.pow(enlargement(width), -0.5)


def prune_factor(width: int) -> float:
    """Return the factor on the squared error below which a Gaussian is not missed: finer pictures need smaller ones."""
    return math.pow(enlargement(width), -1.1)
