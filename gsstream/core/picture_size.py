"""Settings are given for small pictures; these rules adapt them to larger ones, so that a recipe fits every size.

Lengths in pixels, the price of a bit and the thresholds of growth are chosen on pictures 320 pixels wide. A wider
picture of the same scene shows everything larger and more of its detail, so each setting follows the width by a rule of
its own; narrower pictures keep the setting as it is. The exponents are ours, fitted to runs at widths of 320, 640, 676
and 1352 (docs/results/extremes.md).
"""

from __future__ import annotations

import math

#: Width, and number of pixels, of the pictures for which settings are given.
WIDTH, PIXELS = 320, 320 * 240
#: Widths up to which a picture is small, and from which it is large. Between them every rule goes from one to the other
#: with the logarithm of the width, so that no two widths that are close to each other are encoded differently.
SMALL, LARGE = 640, 1280
#: Number of pixels from which a loss may keep what it computes of its target as 16-bit codes, to save memory. No digit
#: that a player shows depends on the codes.
COMPACT_PIXELS = 1 << 19


def largeness(width: int) -> float:
    """Return how far a picture of this width is from small to large, 0 to 1."""
    return min(max(math.log(width / SMALL) / math.log(LARGE / SMALL), 0.0), 1.0)


def far_weight(width: int) -> float:
    """Return the weight, 0 to 1, of tiles away from every change in what a residual is compared with.

    In small pictures, these tiles keep what stands still from wearing away over many frames. In large ones, rows that
    change reach half as many tiles more for them, a sixth of the time of a residual.
    """
    return 1.0 - largeness(width)


def enlargement(width: int) -> float:
    """Return how many times wider than 320 pixels a picture is, at least 1: the factor on lengths in pixels."""
    return max(1.0, width / WIDTH)


def bit_price_factor(pixels: int) -> float:
    """Return the factor on the price of a bit, which is divided by the pixels of a view.

    Without this factor a bit would become cheaper in proportion to the number of pixels, though the picture shows a
    motion no better for it.
    """
    return math.pow(max(1.0, pixels / PIXELS), 0.75)


def densify_factor(width: int) -> float:
    """Return the factor on the mean screen gradient, in half image widths, above which a Gaussian is densified.

    A Gaussian of a given number of pixels has a smaller part in the mean over a larger picture. Where covered area has
    a price (:func:`area_price`), a lower threshold restores the Gaussians that the price removes.
    """
    return math.pow(enlargement(width), -0.5) * math.pow(0.8, largeness(width))


def area_price(width: int) -> float:
    """Return what one Gaussian more at every pixel costs in frame 0, in units of the loss.

    Small pictures have no such price: in pictures 320 and 640 wide it saves bytes and time, but costs 0.1 to 0.3 dB on
    training cameras left out. In large pictures, blending is most of the time.
    """
    return 2e-4 * largeness(width)


def prune_factor(width: int) -> float:
    """Return the factor on the squared error below which a Gaussian is not missed: finer pictures need smaller ones."""
    return math.pow(enlargement(width), -1.1)
