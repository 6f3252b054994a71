"""The residual of all attributes side by side, as one table: a few large operations instead of many small ones.

Latents of all attributes are the columns of one [A, L] table. Their decoders are the blocks of one [L, D] matrix
(identity where an attribute has no decoder). The changes of all attributes are the columns of one [A, D] table.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch

from gsstream.core.gaussians import Gaussians

Columns = Mapping[str, slice]


@dataclass(frozen=True, slots=True)
class AttributeCode:
    """How the residual of one attribute is represented.

    Arguments:
        step: quantisation step in latent units (position: fraction of the Gaussian's unit).
        lr: Adam learning rate of the latents, latent units per iteration.
        latent: number of latent channels; 0 means identity (one latent per feature, no decoder).
        decoder_lr: Adam learning rate of the linear decoder.
        decoder_std: standard deviation of the decoder's initial entries.
    """

    step: float
    lr: float
    latent: int = 0
    decoder_lr: float = 0.0
    decoder_std: float = 0.0


@dataclass(frozen=True)
class JointLayout:
    """The places of each attribute's latents and features in the tables that hold all attributes side by side.

    Arguments:
        latent, feature: attribute -> its columns of the latents [A, L] and of the features [A, D].
        steps: [L] quantisation steps, latent units.
        lrs: [L] learning rates of the latents. decoder_lrs: [L, 1] those of the decoders, by row; 0: not trained.
        trained: [L, D] 1 in the blocks of decoders, else 0.
    """

    latent: Columns
    feature: Columns
    steps: torch.Tensor
    lrs: torch.Tensor
    decoder_lrs: torch.Tensor
    trained: torch.Tensor

    @property
    def width(self) -> int:
        """L: the number of latent channels of all attributes together."""
        return len(self.steps)

    def split(self, latents: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return views of the table [A, L] by attribute."""
        return {name: latents[:, columns] for name, columns in self.latent.items()}

    def join_decoders(self, decoders: Mapping[str, torch.Tensor]) -> torch.Tensor:
        """Return the decoders of all attributes as one matrix [L, D]; identity for attributes without one."""
        matrix = self.trained.new_zeros(self.trained.shape)
        for name, rows in self.latent.items():
            block = matrix[rows, self.feature[name]]
            block.copy_(decoders[name] if name in decoders else block.new_ones(len(block)).diag())
        return matrix

    def split_decoders(self, matrix: torch.Tensor, names: Mapping[str, object]) -> dict[str, torch.Tensor]:
        """Return the blocks of the attributes in ``names``, which are their decoders."""
        return {name: matrix[self.latent[name], self.feature[name]].clone() for name in names}


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
        columns = width_of(getattr(base, name))
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


def width_of(value: torch.Tensor) -> int:
    """Return the numbers of an attribute [N, ...] of one Gaussian."""
    return math.prod(value.shape[1:])
