"""What a frame trains: latents, decoders, centres and gates of the old rows, and everything of the new ones."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch

from gsstream.api import ATTRIBUTES, Gaussians
from gsstream.blocks import bit_price_factor, rate_gradient
from gsstream_queen.gates import BOUND, gates, open_probability
from gsstream_queen.latents import DECODER_LRS, Tensors, coded, decoder, rounded, width
from gsstream_queen.settings import QueenConfig

#: 3DGS, raw units per iteration (centres: fraction of the rig's extent from the settings).
ADDED_LRS = {"quats": 1e-3, "scales": 5e-3, "opacities": 0.05, "sh0": 2.5e-3, "shN": 1.25e-4}
#: Under the root of the latents' variance, symbols squared.
SPREAD_EPSILON = 1e-8
ADAM_EPS = 1e-15  # 3DGS: tiny gradients of tiny Gaussians must still move them


@dataclass(frozen=True)
class Solution:
    """What the old rows were trained to, as integers: by attribute, symbols [A, L] int32 and decoders [L, D]."""

    symbols: Tensors
    decoders: Tensors


class OldRows:
    """A rows of the scene before: base + residual, as it will be sent. Lives only while a frame is optimised."""

    def __init__(
        self,
        config: QueenConfig,
        base: Gaussians[torch.Tensor],
        logits: torch.Tensor,
        weights: Mapping[str, torch.Tensor],
        extent: float,
        total: int,
        pixels: int,
    ) -> None:
        """``base`` are the A rows, ``logits`` [A] their gates, ``total`` the N of the scene.

        ``pixels`` of a training view: bits are weighed by them.
        """
        self._config, self._base, self._total = config, base, total
        self._rate = config.rate * bit_price_factor(pixels) / pixels
        self._unit = config.means.step * extent
        self._policies = coded(config.latents(), base)
        self._latents = {n: torch.zeros(len(base), p.latent, requires_grad=True) for n, p in self._policies.items()}
        self._weights = {name: weights[name].clone().requires_grad_() for name in self._policies}
        self._shift = torch.zeros(len(base), 3, requires_grad=True)
        self._logits = logits.clone().requires_grad_()
        self._moving = config.means.policy != "frozen" and config.means.lr > 0
        groups = [{"params": [self._latents[name]], "lr": policy.lr} for name, policy in self._policies.items()]
        groups += [{"params": [self._weights[name]], "lr": DECODER_LRS[name]} for name in self._policies]
        if self._moving:
            # The shift is counted in steps of the quantiser, so that symbols are its rounded values.
            groups.append({"params": [self._shift], "lr": config.means.lr / config.means.step})
        if self._moving and config.means.policy == "gated":
            groups.append({"params": [self._logits], "lr": config.gate.lr})
        self._adam = torch.optim.Adam(groups, eps=ADAM_EPS, fused=True) if groups else None

    def values(self) -> Gaussians[torch.Tensor]:
        """The rows with their quantised residuals; differentiable."""
        changed = dict(self._base.items())
        for name, policy in self._policies.items():
            base = changed[name]
            weight = decoder(name, self._weights[name], policy.latent, width(self._base, name))
            changed[name] = base + (rounded(self._latents[name]) @ weight).reshape(base.shape)
        if self._moving:
            changed["means"] = self._base.means + rounded(self._gated_translation()) * self._unit
        return Gaussians(**changed)

    def _gated_translation(self) -> torch.Tensor:
        if self._config.means.policy == "direct":
            return self._shift
        return self._shift * gates(self._logits, self._config.gate)[:, None]

    def step(self) -> None:
        """Add the gradient of the L0 penalty, step everything once, keep the logits in their bounds."""
        if self._adam is None:
            return
        penalty = self._penalty()
        if penalty.requires_grad:
            penalty.backward()  # type: ignore[no-untyped-call]
        if self._rate:
            for latents in self._latents.values():
                number, channels = latents.shape
                bits = rate_gradient(latents.detach(), torch.ones(channels), torch.ones(number), self._rate)
                latents.grad = bits if latents.grad is None else latents.grad + bits
        self._adam.step()
        self._adam.zero_grad(set_to_none=True)
        self._logits.data.clamp_(-BOUND, BOUND)

    def _penalty(self) -> torch.Tensor:
        """L0 of the gates (paper, Eq. 8) and the spread of the latents (paper, appendix A.2)."""
        penalty, gate = torch.zeros(()), self._config.gate
        if self._moving and self._config.means.policy == "gated" and gate.l0:
            opened = open_probability(self._logits, gate).sum()
            penalty = penalty + gate.l0 * (opened if gate.l0_over == "sum" else opened / self._total)
        if self._config.sigma and len(self._base) > 1 and self._latents:
            # The root has no derivative at a spread of 0, where every frame begins.
            spread = [(value.var(0) + SPREAD_EPSILON).sqrt().sum() for value in self._latents.values()]
            channels = sum(value.shape[1] for value in self._latents.values())
            penalty = penalty + self._config.sigma * torch.stack(spread).sum() / channels
        return penalty

    def solution(self) -> Solution:
        """The integers, and the decoders they go through."""
        with torch.no_grad():
            symbols = {name: torch.round(value).to(torch.int32) for name, value in self._latents.items()}
            if self._moving:
                symbols["means"] = torch.round(self._gated_translation()).to(torch.int32)
            decoders = {
                name: decoder(name, self._weights[name], policy.latent, width(self._base, name)).detach().clone()
                for name, policy in self._policies.items()
            }
        return Solution(symbols, decoders)


class NewRows:
    """Gaussians added in this frame: every attribute free, rates of 3DGS."""

    def __init__(self, added: Gaussians[torch.Tensor], lr_means: float) -> None:
        """``lr_means``: scene units per iteration."""
        self._leaves = {name: value.detach().clone().requires_grad_() for name, value in added.items()}
        rates = {"means": lr_means, **ADDED_LRS}
        groups = [{"params": [self._leaves[name]], "lr": rates[name]} for name in ATTRIBUTES]
        self._adam = torch.optim.Adam(groups, eps=ADAM_EPS, fused=True)

    def __len__(self) -> int:
        return len(self._leaves["means"])

    def values(self) -> Gaussians[torch.Tensor]:
        """The rows; differentiable."""
        return Gaussians(**self._leaves)

    def step(self) -> None:
        self._adam.step()
        self._adam.zero_grad(set_to_none=True)


def concat(groups: list[Gaussians[torch.Tensor]]) -> Gaussians[torch.Tensor]:
    """Rows of several groups, in order."""
    if len(groups) == 1:
        return groups[0]
    return Gaussians(**{name: torch.cat([getattr(group, name) for group in groups]) for name in ATTRIBUTES})
