"""From magnitudes to logits: pure functions of a [n] float64 vector, n >= 1, entries finite and >= 0."""

from __future__ import annotations

import torch


def median(values: torch.Tensor) -> torch.Tensor:
    """The median; the mean of the two middle values when n is even (torch.median would take the lower)."""
    low, high = (values.kthvalue(place + 1).values for place in ((len(values) - 1) // 2, len(values) // 2))
    return low + (high - low) / 2


def robust(values: torch.Tensor, epsilon: float, relative: bool, limit: float) -> torch.Tensor:
    """(m - median) / (MAD + eps) (paper). If the MAD and eps are 0: sign(deviation) * limit."""
    center = median(values)
    spread = median((values - center).abs())
    scale = spread + (epsilon * (center + spread) if relative else epsilon)
    if float(scale) == 0.0:
        return torch.sign(values - center) * limit
    return (values - center) / scale


def ratio(values: torch.Tensor, floor: float, limit: float) -> torch.Tensor:
    """ln(m / median) = logit(m / (m + median)) (released code, where 0 / 0 is NaN). ``floor`` at m = 0."""
    center = median(values)
    moved = values > 0
    if float(center) == 0.0:
        logits = torch.full_like(values, limit)
    else:
        logits = torch.log(values.where(moved, center)) - torch.log(center)
    return logits.where(moved, torch.full_like(values, floor))


def minmax(values: torch.Tensor, limit: float) -> torch.Tensor:
    """logit of (m - min) / (max - min) (paper's ablation); 0 when all are equal."""
    below, above = values - values.min(), values.max() - values
    if float(below.max()) == 0.0:
        return torch.zeros_like(values)
    # At both ends the logit is infinite: they get the limit here, and not only by the clamp of the caller.
    logits = torch.log(below) - torch.log(above)
    logits = logits.where(below > 0, torch.full_like(values, -limit))
    return logits.where(above > 0, torch.full_like(values, limit))


def noise_units(values: torch.Tensor, expected: torch.Tensor, threshold: float, floor: float) -> torch.Tensor:
    """m / (m expected from noise) - threshold. ``floor`` where not even noise moves the Gaussian."""
    reached = expected > 0
    logits = values / expected.where(reached, torch.ones_like(expected)) - threshold
    return logits.where(reached, torch.full_like(values, floor))
