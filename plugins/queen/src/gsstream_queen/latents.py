"""Attributes behind integer latents and linear decoders; rounding is real, its gradient straight-through."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch

from gsstream.api import Gaussians, Rng
from gsstream_queen.settings import LatentPolicy

Tensors = dict[str, torch.Tensor]
#: Attribute -> Adam learning rate of its decoder, raw units per iteration.
DECODER_LRS = {"quats": 1e-3, "scales": 1e-4, "opacities": 1e-4, "sh0": 1e-3, "shN": 1e-4}
#: Attribute -> standard deviation of its decoder's first entries, raw units per symbol (published).
DECODER_STDS = {"quats": 1e-2, "scales": 1e-3, "opacities": 1e-4, "sh0": 1e-4, "shN": 1e-1}
#: Attributes whose decoders are cosines times one learned number; of others every entry is learned.
COSINE = ("opacities",)


def width(gaussians: Gaussians[torch.Tensor], name: str) -> int:
    """Numbers per Gaussian of an attribute."""
    return math.prod(getattr(gaussians, name).shape[1:])


def coded(policies: Mapping[str, LatentPolicy], gaussians: Gaussians[torch.Tensor]) -> dict[str, LatentPolicy]:
    """The policies of attributes that the scene has (there is no higher colour at degree 0)."""
    return {name: policy for name, policy in policies.items() if width(gaussians, name)}


def initial_weights(policies: Mapping[str, LatentPolicy], gaussians: Gaussians[torch.Tensor], rng: Rng) -> Tensors:
    """Attribute -> learned numbers of its decoder: all entries [L, D], or one number [1, 1] (cosine)."""
    found = {}
    for name, policy in coded(policies, gaussians).items():
        shape = (policy.latent, width(gaussians, name)) if name not in COSINE else (1, 1)
        found[name] = torch.randn(shape, generator=rng.stream(f"queen decoder {name}")) * DECODER_STDS[name]
    return found


def decoder(name: str, weight: torch.Tensor, latent: int, columns: int) -> torch.Tensor:
    """Return the decoder [L, D] of an attribute from its learned weights."""
    return weight * cosines(latent, columns) if name in COSINE else weight


def cosines(latent: int, columns: int) -> torch.Tensor:
    """[L, D] discrete cosine basis, entry cos(pi l (2 d + 1) / (2 L)), our reading of "DFT-like"."""
    rows, places = torch.arange(latent)[:, None], torch.arange(columns)[None]
    return torch.cos(math.pi * rows * (2 * places + 1) / (2 * latent))


def weight_of(name: str, sent: torch.Tensor) -> torch.Tensor:
    """Return the learned weights behind the decoder [L, D] of an attribute that was sent."""
    # The first row of the cosine basis is 1 everywhere.
    return sent[:1, :1].clone() if name in COSINE else sent


def rounded(values: torch.Tensor) -> torch.Tensor:
    """Nearest integers; the gradient passes as if nothing were rounded."""
    return torch.round(values.detach()) + (values - values.detach())
