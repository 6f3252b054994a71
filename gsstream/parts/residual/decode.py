"""From latents to attributes: what a residual decodes to, and the gradient of that map.

The map is that of :func:`gsstream.core.changes.apply_delta`, up to rounding, for all attributes at once.
"""

from __future__ import annotations

from typing import NamedTuple

import torch

from gsstream.core.gaussians import Gaussians
from gsstream.parts.residual.layout import JointLayout


def join_features(code: JointLayout, rows: Gaussians[torch.Tensor]) -> torch.Tensor:
    """Return [A, D]: the attributes that may change, side by side."""
    # The width is given explicitly, because with no rows left reshape could not infer it from -1.
    parts = [getattr(rows, name).reshape(len(rows), at.stop - at.start) for name, at in code.feature.items()]
    return torch.cat(parts, 1) if parts else rows.means.new_zeros(len(rows), 0)


class JointResidual(NamedTuple):
    """Quantised latents [A, L] and the ungated change of the features [A, D] (positions in scene units)."""

    latents: torch.Tensor
    decoded: torch.Tensor


def decode_joint(code: JointLayout, latents: torch.Tensor, matrix: torch.Tensor, units: torch.Tensor) -> JointResidual:
    """Return the latents [A, L] as the decoder will have them, and what they decode to.

    Arguments:
        code: columns of the attributes.
        latents: [A, L].
        matrix: [L, D] of :meth:`JointLayout.join_decoders`. units: [A] cell of each anchor, scene units.
    """
    quantised = torch.round(latents / code.steps).mul_(code.steps)
    decoded = quantised @ matrix
    if "means" in code.feature:
        decoded[:, code.feature["means"]].mul_(units[:, None])
    return JointResidual(quantised, decoded)


def add_joint(
    code: JointLayout, base: Gaussians[torch.Tensor], features: torch.Tensor, change: JointResidual, gates: torch.Tensor
) -> Gaussians[torch.Tensor]:
    """Return a_t = a_{t-1} + g * change.

    Arguments:
        code: columns of the attributes.
        base: the A rows before.
        features: [A, D] the changing attributes of ``base``.
        change: [A, D] decoded residual.
        gates: [A] in [0, 1].
    """
    changed = torch.addcmul(features, change.decoded, gates[:, None])
    parts = dict(base.items())
    for name, columns in code.feature.items():
        parts[name] = changed[:, columns].reshape(parts[name].shape).contiguous()
    return Gaussians(**parts)


class JointGrad(NamedTuple):
    """Gradients of latents [A, L], decoders [L, D] and gates [A]."""

    latents: torch.Tensor
    matrix: torch.Tensor
    gates: torch.Tensor


def joint_vjp(
    code: JointLayout,
    upstream: torch.Tensor,
    change: JointResidual,
    matrix: torch.Tensor,
    gates: torch.Tensor,
    units: torch.Tensor,
) -> JointGrad:
    """Return the gradient of the map from latents, decoders and gates to features.

    Rounding counts as the identity.

    Arguments:
        code: columns of the attributes.
        upstream: [A, D] gradient with respect to the changed features.
        change: what :func:`decode_joint` returned.
        matrix: [L, D] decoders.
        gates: [A] in [0, 1].
        units: [A] unit of each row, scene units.
    """
    by_gate = (upstream * change.decoded).sum(1)
    gated = upstream * gates[:, None]
    if "means" in code.feature:
        gated[:, code.feature["means"]].mul_(units[:, None])
    return JointGrad(gated @ matrix.T, (change.latents.T @ gated).mul_(code.trained), by_gate)
