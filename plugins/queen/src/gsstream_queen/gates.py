"""Hard-concrete gates without noise: logit -> sigmoid -> stretched -> clipped to [0, 1] (Louizos et al. 2018)."""

from __future__ import annotations

import math

import torch

from gsstream_queen.settings import GateSettings

#: Ends of the interval that the sigmoid is stretched to (published gamma and eta).
GAMMA, ETA = -0.5, 1.01
#: Logits are kept within ln 1000, so that no gate is surer than that (released code of the family).
BOUND = math.log(1000.0)


def open_logit(settings: GateSettings) -> float:
    """Logit at which the stretched gate begins to open: temperature * ln(-GAMMA / ETA)."""
    return settings.temperature * math.log(-GAMMA / ETA)


def initial_logits(difference: torch.Tensor, seen: torch.Tensor, settings: GateSettings) -> torch.Tensor:
    """[N] logits such that a gate is open with p = m / (m + median), the published confidence."""
    logits = torch.full_like(difference, -BOUND)
    changed = seen & (difference > 0)
    if not bool(changed.any()):
        return logits
    median = difference[seen].median()
    # ln p / (1 - p) = ln m / median; over a median of 0 everything that changed is sure.
    sure = torch.full_like(difference[changed], BOUND)
    logits[changed] = (difference[changed] / median).log() + open_logit(settings) if float(median) > 0 else sure
    return logits.clamp(-BOUND, BOUND)


def gates(logits: torch.Tensor, settings: GateSettings) -> torch.Tensor:
    """[N] in [0, 1], exactly 0 and 1 at the ends; no gradient there, as published."""
    soft = torch.sigmoid(logits / settings.temperature)
    return (soft * (ETA - GAMMA) + GAMMA).clamp(0, 1)


def open_probability(logits: torch.Tensor, settings: GateSettings) -> torch.Tensor:
    """Return [N]: the probability that a gate with noise is not 0, which the L0 penalty sums."""
    return torch.sigmoid(logits - open_logit(settings))
