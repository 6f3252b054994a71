"""Where the residual of each attribute lies in one table of all of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import torch

Columns = Mapping[str, slice]


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
        """L."""
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
