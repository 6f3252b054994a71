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
#: Width from which a picture is large: what lies away from a change is then told without its pixels, what a loss keeps
#: of its target may be rounded to 16 bits, and what a Gaussian covers has a price.
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

    A Gaussian of a given number of pixels has a smaller part in the mean over a larger picture. Where what is covered
    has a price (:func:`area_price`), a lower threshold gives back the Gaussians that the price takes.
    """
    return math.pow(enlargement(width), -0.5) * (0.8 if area_price(width) else 1.0)


def area_price(width: int) -> float:
    """Return what one Gaussian more at every pixel costs in frame 0, in units of the loss.

    Only large pictures have this price: there, blending is most of the time. In pictures 320 and 640 wide it saves
    bytes and time, too, but costs 0.1 to 0.3 dB on training cameras left out.
    """
    return 2e-4 if is_large(width) else 0.0


def prune_factor(width: int) -> float:
    """Return the factor on the squared error below which a Gaussian is not missed: finer pictures need smaller ones."""
    return math.pow(enlargement(width), -1.1)
