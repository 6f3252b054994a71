"""What a residual will cost, estimated smoothly: bits of a Laplace model per latent channel, fitted to the latents.

The packet codes every channel by a histogram of its own symbols; a discretised Laplace of the channel's own spread is
its smooth stand-in (the factorised model of learned compression, Balle et al. 2018, without learned parameters).
"""

from __future__ import annotations

import math

import torch

#: Least spread of a channel, symbols, so that a channel that is all zeros can leave zero. At 0.3 a zero costs 0.3 bits.
MIN_SPREAD = 0.3
_LN2 = math.log(2.0)


def channel_spread(latents: torch.Tensor, step: float | torch.Tensor) -> torch.Tensor:
    """Return [L]: the scale b > 0 of a Laplace law fitted to the symbols of each channel.

    It is their mean magnitude, at least MIN_SPREAD.
    """
    return torch.round(latents.detach() / step).abs().mean(0).clamp_min(MIN_SPREAD)


def laplace_bits(latents: torch.Tensor, step: float | torch.Tensor, spread: torch.Tensor) -> torch.Tensor:
    """Return [A, L]: bits of each latent, -log2 of the mass of Laplace(0, b) within half a symbol of it."""
    u, half = (latents / step).abs(), 0.5 / spread
    inside = -torch.log1p(-torch.exp(-half) * torch.cosh(u.clamp_max(0.5) / spread))
    outside = u / spread - torch.log(torch.sinh(half))
    return torch.where(u < 0.5, inside, outside) / _LN2


def laplace_gradient(
    latents: torch.Tensor, step: float | torch.Tensor, spread: torch.Tensor, weight: float | torch.Tensor = 1.0
) -> torch.Tensor:
    """Return [A, L]: derivative of ``weight`` times :func:`laplace_bits` by the latents. The spread is held fixed."""
    u = latents / step
    magnitude = u.abs()
    # (e^x - e^-x) t / (2 - (e^x + e^-x) t) with t = e^-half is sinh x / (e^half - cosh x).
    x = magnitude.clamp_max(0.5) / spread
    inside = torch.sinh(x).div_(torch.exp(0.5 / spread) - torch.cosh(x))
    return torch.where(magnitude < 0.5, inside, 1.0).copysign_(u).div_(spread * (step * (_LN2 / weight)))


def rate_gradient(
    latents: torch.Tensor, steps: torch.Tensor, gates: torch.Tensor, weight: float | torch.Tensor
) -> torch.Tensor:
    """Return [A, L]: gradient of ``weight`` times the bits of all rows behind open gates.

    It is to be added to the gradient of the latents.

    Arguments:
        latents: [A, L] of all attributes, side by side. steps: [L] latent units per symbol.
        gates: [A] in [0, 1]; rows at 0 are not sent and cost nothing. weight: loss per bit, above 0.
    """
    # A factor and no selection: to count the rows behind open gates, a GPU is waited for.
    gradient = laplace_gradient(latents, steps, channel_spread(latents, steps), weight)
    return gradient.mul_((gates > 0)[:, None])
