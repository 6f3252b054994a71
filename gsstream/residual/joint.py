"""The residual of all attributes side by side, as one table: a few large operations instead of many small ones.

Latents of all attributes are the columns of one [A, L] table, their decoders the blocks of one [L, D] matrix (identity
where an attribute has no decoder), what changes the columns of one [A, D] table. The map is that of
:func:`gsstream.core.changes.apply_delta`, up to rounding.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch

from gsstream.core.gaussians import Gaussians
from gsstream.core.joint import JointCode as JointCode
from gsstream.residual.base import AttributeCode


def joint_code(
    codes: Mapping[str, AttributeCode], latents: Mapping[str, torch.Tensor], decoders: Mapping[str, torch.Tensor],
    base: Gaussians[torch.Tensor],
) -> JointCode:  # fmt: skip
    """Return the columns that attributes have in one table, in the order of ``latents``.

    Arguments:
        codes: attribute -> code.
        latents: attribute -> [A, l].
        decoders: attribute -> [l, d] linear decoder; an attribute without one uses its latents directly.
        base: the A rows.
    """
    latent, feature, steps, lrs, decoder_lrs = {}, {}, [], [], []
    at = wide = 0
    for name, value in latents.items():
        code, rows = codes[name], value.shape[1]
        columns = _width(getattr(base, name))
        latent[name], feature[name] = slice(at, at + rows), slice(wide, wide + columns)
        at, wide = at + rows, wide + columns
        steps += [code.step] * rows
        lrs += [code.lr] * rows
        decoder_lrs += [code.decoder_lr if name in decoders else 0.0] * rows
    kind = base.means.dtype
    trained = torch.zeros(at, wide, dtype=kind)
    for name in decoders:
        trained[latent[name], feature[name]] = 1
    rates = torch.tensor(decoder_lrs, dtype=kind)[:, None]
    return JointCode(
        latent, feature, torch.tensor(steps, dtype=kind), torch.tensor(lrs, dtype=kind), rates, trained
    )


def join_features(code: JointCode, rows: Gaussians[torch.Tensor]) -> torch.Tensor:
    """Return [A, D]: the attributes that may change, side by side."""
    # The width is given explicitly, because with no rows left reshape could not infer it from -1.
    parts = [getattr(rows, name).reshape(len(rows), at.stop - at.start) for name, at in code.feature.items()]
    return torch.cat(parts, 1) if parts else torch.zeros(len(rows), 0)


class JointChange(NamedTuple):
    """Quantised latents [A, L] and the ungated change of the features [A, D] (positions in scene units)."""

    latents: torch.Tensor
    decoded: torch.Tensor


def decode_joint(code: JointCode, latents: torch.Tensor, matrix: torch.Tensor, units: torch.Tensor) -> JointChange:
    """Return the latents [A, L] as the decoder will have them, and what they decode to.

    Arguments:
        code: columns of the attributes.
        latents: [A, L].
        matrix: [L, D] of :meth:`JointCode.join_decoders`. units: [A] cell of each anchor, scene units.
    """
    quantised = torch.round(latents / code.steps).mul_(code.steps)
    decoded = quantised @ matrix
    if "means" in code.feature:
        decoded[:, code.feature["means"]] *= units[:, None]
    return JointChange(quantised, decoded)


def add_joint(
    code: JointCode, base: Gaussians[torch.Tensor], features: torch.Tensor, change: JointChange, gates: torch.Tensor
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


class JointPullback(NamedTuple):
    """Gradients of latents [A, L], decoders [L, D] and gates [A]."""

    latents: torch.Tensor
    matrix: torch.Tensor
    gates: torch.Tensor


def pull_back_joint(
    code: JointCode, upstream: torch.Tensor, change: JointChange, matrix: torch.Tensor, gates: torch.Tensor,
    units: torch.Tensor,
) -> JointPullback:  # fmt: skip
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
        gated[:, code.feature["means"]] *= units[:, None]
    return JointPullback(gated @ matrix.T, (change.latents.T @ gated).mul_(code.trained), by_gate)


def _width(value: torch.Tensor) -> int:
    return int(torch.tensor(value.shape[1:]).prod())
