"""RowOptimiser: Adam on tables of which every row counts its own steps."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

import torch

from gsstream.core.gaussians import Gaussians
from gsstream.parts.residual.adam_state import AdamState
from gsstream.parts.residual.layout import JointLayout
from gsstream.parts.residual.optimiser import ResidualOptimiser
from gsstream.parts.residual.rate import rate_gradient
from gsstream.parts.residual.reference import JointResidualOptimiser


class RowOptimiser(ABC):
    """Adam (Kingma and Ba 2015, algorithm 1; betas 0.9 / 0.999, eps 1e-15) with each row's bias corrected by its count.

    Where all rows take all steps this is ``torch.optim.Adam``, to 1e-6.
    """

    @abstractmethod
    def step(
        self,
        values: Mapping[str, torch.Tensor],
        gradients: Mapping[str, torch.Tensor],
        states: Mapping[str, AdamState],
        lrs: Mapping[str, float | torch.Tensor],
    ) -> None:
        """Update every named table that has a gradient. Changes ``values`` and ``states`` in place.

        Arguments:
            values: name -> [n, ...] float32, contiguous; leaves of a graph are allowed.
            gradients: like the table each; names that are missing are not moved and count no step.
            states: their moments.
            lrs: their learning rates, >= 0: one number, [d] by column of [n, d], or [n, 1] by row.

        Raises:
            ShapeError: shapes that differ, a gradient that is not finite or beyond MAX_GRADIENT (that table is not
                changed then). On a GPU the gradient is looked at through ``gsstream.core.deferred``: the error may come
                at the end of the pass, and the table is of no use then.
        """

    def add_rate(
        self,
        gradient: torch.Tensor,
        latents: torch.Tensor,
        steps: torch.Tensor,
        gates: torch.Tensor,
        weight: float | torch.Tensor,
    ) -> None:
        """Add to ``gradient`` what the bits of a residual say (:func:`gsstream.parts.residual.rate.rate_gradient`).

        This body is the truth; another gives the same numbers up to rounding.

        Arguments:
            gradient: [A, L] by the latents, changed in place. latents: [A, L].
            steps: [L] latent units per symbol. gates: [A] in [0, 1]; rows at 0 cost nothing.
            weight: loss per bit, above 0, a number or a tensor [].
        """
        gradient.add_(rate_gradient(latents, steps, gates, weight))

    def residual_optimiser(
        self, code: JointLayout, base: Gaussians[torch.Tensor], units: torch.Tensor, matrix: torch.Tensor
    ) -> ResidualOptimiser[Any]:
        """Return the optimiser of a frame's residual, from zero latents on. By default it is made of :meth:`step`.

        Its epochs have sessions of the renderer that brings this optimiser.

        Arguments:
            code: columns of the attributes.
            base: the A rows that the residual is added to.
            units: [A] unit of the position of each row, scene units.
            matrix: [L, D] decoders to start from.
        """
        return JointResidualOptimiser(code=code, base=base, units=units, matrix=matrix, optimiser=self)
