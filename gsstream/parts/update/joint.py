"""The residual of all attributes side by side, as one table: a few large operations instead of many small ones.

Latents of all attributes are the columns of one [A, L] table, their decoders the blocks of one [L, D] matrix (identity
where an attribute has no decoder), what changes the columns of one [A, D] table. What is done
with the table is in ``gsstream.parts.optimiser.joint``.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch

from gsstream.core.gaussians import Gaussians
from gsstream.core.joint import JointLayout as JointLayout
from gsstream.parts.update.base import AttributeCode


def joint_layout(
    codes: Mapping[str, AttributeCode],
    latents: Mapping[str, torch.Tensor],
    decoders: Mapping[str, torch.Tensor],
    base: Gaussians[torch.Tensor],
) -> JointLayout:
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
    trained = base.means.new_zeros(at, wide)
    for name in decoders:
        trained[latent[name], feature[name]] = 1
    rates = trained.new_tensor(decoder_lrs)[:, None]
    return JointLayout(
        latent=latent,
        feature=feature,
        steps=trained.new_tensor(steps),
        lrs=trained.new_tensor(lrs),
        decoder_lrs=rates,
        trained=trained,
    )


def _width(value: torch.Tensor) -> int:
    return int(torch.tensor(value.shape[1:]).prod())
