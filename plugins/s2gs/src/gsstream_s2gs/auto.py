"""What a scene asks of the octree and of the residuals: the rules behind ``auto``. See docs/results/auto.md.

Pure functions of a scene's facts and of what was chosen before. Their constants were set on two recordings.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from gsstream.api import AutoRule, Choice, SceneFacts

#: Distance ratios of two levels that log_base chooses from.
BASES = (1.15, 1.2, 1.25, 1.3, 1.4, 1.5, 1.75, 2.0, 2.5, 3.0)
#: Training pixels for each anchor that frame 0 starts with.
PIXELS_PER_ANCHOR = 14.0
#: Side of the finest cell at the median distance, pixels.
FINEST_CELL = 0.05
MOST_LEVELS = 10
#: Numbers of levels worth trying.
LEVELS = (1, 2, 3, 4, 6, 8, MOST_LEVELS)
#: Least and largest exponent of the root grid chosen.
EXPONENTS = (2, 12)
#: What harmonics must gain for a left-out camera, dB, before their residuals are worth bytes.
STRONG_GAIN = 1.0


def root_exponent(facts: SceneFacts, _config: Any) -> Choice:
    """The exponent at which a root cell is nearest to the distance of two seeds, on a logarithmic scale.

    Wider cells merge seeds, and what is merged is missing in frame 0; narrower ones group no two Gaussians.
    """
    k = _between(EXPONENTS[0], _rounded(math.log2(max(facts.span_spacings, 1.0))), EXPONENTS[1])
    cells = 2**k / facts.span_spacings if facts.span_spacings > 0 else math.inf
    # Farther from the spacing of the seeds, a few left-out cameras have been seen to lead astray (sceaux).
    ladder = tuple(e for e in (k - 1, k, k + 1) if EXPONENTS[0] <= e <= EXPONENTS[1])
    return Choice(k, f"neighbouring seeds are {cells:.2g} root cells apart", ladder)


def log_base(facts: SceneFacts, config: Any) -> Choice:
    """The base at which the number of anchors is nearest to the training pixels / PIXELS_PER_ANCHOR, by ratio."""
    wanted = max(1.0, facts.pixels / PIXELS_PER_ANCHOR)
    expected = {base: anchors(facts, base, config.max_levels) for base in BASES}
    base = min(BASES, key=lambda b: (abs(math.log(expected[b] / wanted)), -b))
    return Choice(base, f"about {expected[base]:,.0f} anchors for {facts.pixels:,} training pixels", BASES)


def anchors(facts: SceneFacts, base: float, max_levels: int) -> float:
    """Anchors expected of that base: every seed has one on each level that its distances ask for."""
    levels = [1 + min(max_levels - 1, math.floor(close / math.log(base))) for close in facts.closeness]
    return max(1.0, facts.seeds * sum(levels) / len(levels))


def max_levels(facts: SceneFacts, config: Any) -> Choice:
    """As many levels as it takes from the root cell down to cells of FINEST_CELL pixels."""
    width = max(facts.span_pixels, 1e-9) / 2**config.root_exponent
    levels = _between(1, 1 + _rounded(math.log2(width / FINEST_CELL)), MOST_LEVELS)
    why = f"a root cell is {width:.2g} pixels wide at the median distance of the seeds"
    return Choice(levels, why, tuple(sorted({levels, *LEVELS})))


def two_channels(_facts: SceneFacts, _config: Any) -> Choice:
    """Two channels, whatever the scene: nowhere were more of them worth their bytes."""
    return Choice(2, "more channels cost bytes and gained nothing where it was measured")


def colour_channels(facts: SceneFacts, _config: Any) -> Choice:
    """Channels of higher colour: 4, as released, where colour depends on the view a lot, else 1."""
    gain = max(facts.colour_gain)
    return Choice(4 if gain >= STRONG_GAIN else 1, _gain_text(gain))


def colour_rate(facts: SceneFacts, _config: Any) -> Choice:
    """Whether higher colour gets residuals at all: 0 freezes it."""
    gain = max(facts.colour_gain)
    return Choice(0.03 if gain >= STRONG_GAIN else 0.0, _gain_text(gain))


def _gain_text(gain: float) -> str:
    return f"harmonics predict a left-out camera's colours by up to {gain:+.2f} dB better; {STRONG_GAIN:g} is a lot"


def _rounded(value: float) -> int:
    return round(_limit(value))


def _limit(value: float) -> float:
    return max(-1e6, min(1e6, value))


def _between(low: int, value: int, high: int) -> int:
    return max(low, min(high, value))


#: In this order: the number of levels follows the root cell, the base both.
OCTREE_RULES: Mapping[str, AutoRule] = {
    "root_exponent": root_exponent, "max_levels": max_levels, "log_base": log_base,
}  # fmt: skip
LATENT_RULES: Mapping[str, AutoRule] = {
    "quats.latent": two_channels, "scales.latent": two_channels, "sh0.latent": two_channels,
    "shN.latent": colour_channels, "shN.lr": colour_rate,
}  # fmt: skip
