"""An oracle for ``gsstream.parts.residual.decode``: the residual attribute by attribute, differentiated by autograd.

``train_rows`` calls the joint table the way the engine does, with the oracle's arguments.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch

from gsstream.core.gaussians import Gaussians
from gsstream.parts.residual.decode import JointResidual, add_joint, decode_joint, join_features
from gsstream.parts.residual.layout import JointLayout, joint_layout
from gsstream.parts.update.base import UpdateRule


def quantise(latents: torch.Tensor, step: float) -> torch.Tensor:
    """Round to multiples of ``step`` with a straight-through gradient.

    The value is exactly symbol * step, as the decoder has it: latents - latents is 0, whereas latents plus the rounding
    error would be an ulp off.
    """
    return torch.round(latents.detach() / step) * step + (latents - latents.detach())


class Change(NamedTuple):
    """One attribute's ungated residual: quantised latents [A, L] and what they decode to [A, D]."""

    latents: torch.Tensor
    decoded: torch.Tensor


def decode_changes(
    rule: UpdateRule, latents: Mapping[str, torch.Tensor], decoders: Mapping[str, torch.Tensor]
) -> dict[str, Change]:
    """Attribute -> quantised and decoded residual."""
    codes = rule.codes()
    quantised = {name: quantise(latent, codes[name].step) for name, latent in latents.items()}
    return {name: Change(q, q @ decoders[name] if name in decoders else q) for name, q in quantised.items()}


def add_changes(
    base: Gaussians[torch.Tensor], changes: Mapping[str, Change], gates: torch.Tensor, units: torch.Tensor
) -> Gaussians[torch.Tensor]:
    """a_t = a_{t-1} + g * change; position changes are in cells, ``units`` [A] scene units."""
    changed = dict(base.items())
    for name, change in changes.items():
        scale = gates * units if name == "means" else gates
        value = changed[name]
        changed[name] = value + (change.decoded * scale[:, None]).reshape(value.shape)
    return Gaussians(**changed)


def apply_residual(
    rule: UpdateRule,
    base: Gaussians[torch.Tensor],
    gates: torch.Tensor,
    latents: Mapping[str, torch.Tensor],
    decoders: Mapping[str, torch.Tensor],
    units: torch.Tensor,
) -> Gaussians[torch.Tensor]:
    """Gated, quantised, decoded residual on the A rows of ``base``; differentiable.

    Arguments:
        gates: [A] in [0, 1].
        latents: attribute -> [A, L].
        decoders: attribute -> [L, D].
        units: [A] cell of each anchor, scene units.
    """
    return add_changes(base, decode_changes(rule, latents, decoders), gates, units)


def decode_rows(
    rule: UpdateRule,
    base: Gaussians[torch.Tensor],
    latents: Mapping[str, torch.Tensor],
    decoders: Mapping[str, torch.Tensor],
    units: torch.Tensor,
) -> tuple[JointLayout, JointResidual]:
    """The joint table of these latents and what they decode to, as the engine computes it while it trains."""
    code = joint_layout(rule.codes(), latents, decoders, base)
    table = torch.cat(list(latents.values()), 1)
    return code, decode_joint(code, table, code.join_decoders(decoders), units)


def train_rows(
    rule: UpdateRule,
    base: Gaussians[torch.Tensor],
    gates: torch.Tensor,
    latents: Mapping[str, torch.Tensor],
    decoders: Mapping[str, torch.Tensor],
    units: torch.Tensor,
) -> Gaussians[torch.Tensor]:
    """The changed rows as the engine computes them while it trains; arguments of :func:`apply_residual`."""
    code, change = decode_rows(rule, base, latents, decoders, units)
    return add_joint(code, base, join_features(code, base), change, gates)
