"""Attributes behind integer latents and linear decoders; rounding is real, its gradient straight-through."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch

from gsstream.api import Gaussians, Rng
from gsstream_queen.settings import LatentPolicy

Tensors = dict[str, torch.Tensor]


def width(gaussians: Gaussians[torch.Tensor], name: str) -> int:
    """Numbers per Gaussian of an attribute."""
    return math.prod(getattr(gaussians, name).shape[1:])


def coded(policies: Mapping[str, LatentPolicy], gaussians: Gaussians[torch.Tensor]) -> dict[str, LatentPolicy]:
    """The policies of attributes that the scene has (there is no higher colour at degree 0)."""
    return {name: policy for name, policy in policies.items() if width(gaussians, name)}


def initial_weights(policies: Mapping[str, LatentPolicy], gaussians: Gaussians[torch.Tensor], rng: Rng) -> Tensors:
    """Attribute -> what is learned of its decoder: all entries [L, D], or one number [1, 1] (cosine)."""
    found = {}
    for name, policy in coded(policies, gaussians).items():
        shape = (policy.latent, width(gaussians, name)) if policy.basis == "learned" else (1, 1)
        found[name] = torch.randn(shape, generator=rng.stream(f"queen decoder {name}")) * policy.decoder_std
    return found


def decoder(weight: torch.Tensor, policy: LatentPolicy, columns: int) -> torch.Tensor:
    """[L, D] decoder of learned weights."""
    return weight if policy.basis == "learned" else weight * cosines(policy.latent, columns)


def cosines(latent: int, columns: int) -> torch.Tensor:
    """[L, D] discrete cosine basis, entry cos(pi l (2 d + 1) / (2 L)), our reading of "DFT-like"."""
    rows, places = torch.arange(latent)[:, None], torch.arange(columns)[None]
    return torch.cos(math.pi * rows * (2 * places + 1) / (2 * latent))


def weight_of(sent: torch.Tensor, policy: LatentPolicy) -> torch.Tensor:
    """The learned weights behind a decoder [L, D] that was sent."""
    # The first row of the cosine basis is 1 everywhere.
    return sent if policy.basis == "learned" else sent[:1, :1].clone()


def rounded(values: torch.Tensor) -> torch.Tensor:
    """Nearest integers; the gradient passes as if nothing were rounded."""
    return torch.round(values.detach()) + (values - values.detach())
