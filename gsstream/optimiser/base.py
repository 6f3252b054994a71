"""RowOptimiser: Adam on tables of which every row counts its own steps."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from gsstream.core.gaussians import Gaussians
from gsstream.core.joint import JointCode
from gsstream.core.part import Part

ADAM_BETAS = (0.9, 0.999)
ADAM_EPS = 1e-15  # released code and 3DGS: tiny gradients of tiny Gaussians must still move them
#: Largest gradient that is taken. The square of a larger one leaves float32, its mean stays infinite, and the row would
#: never move again without anybody being told.
MAX_GRADIENT = 1e18


@dataclass(frozen=True, slots=True)
class AdamState:
    """Moments of one table of n rows; float32, contiguous.

    Arguments:
        exp_avg, exp_avg_sq: like the table, running means of the gradient and of its square.
        steps: [n] int32, updates that each row has taken. A row that joins later starts with zeros.
    """

    exp_avg: torch.Tensor
    exp_avg_sq: torch.Tensor
    steps: torch.Tensor

    @staticmethod
    def start(values: torch.Tensor) -> AdamState:
        """Return the state before any step, for a table ``values`` [n, ...]."""
        zeros = torch.zeros_like(values, requires_grad=False)
        return AdamState(zeros, zeros.clone(), torch.zeros(len(values), dtype=torch.int32))


class RowOptimiser(Part):
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
                changed then).
        """

    def residual_table(
        self, code: JointCode, base: Gaussians[torch.Tensor], units: torch.Tensor, matrix: torch.Tensor
    ) -> ResidualTable | None:
        """Return a faster :class:`ResidualTable` of zero latents; None: the engine makes its own from :meth:`step`.

        Arguments:
            code: columns of the attributes.
            base: the A rows that the residual is added to.
            units: [A] unit of the position of each row, scene units.
            matrix: [L, D] decoders to start from.
        """
        return None


@dataclass(frozen=True)
class ResidualPass:
    """Some iterations of a frame's residual, in the order in which they are made: what one call may do for all of them.

    Every iteration samples the gates, and calls ``rows``, the session's ``pull``, ``pull`` and ``step`` of the table,
    and between the last two moves the logits by what images and price say.

    Arguments:
        session: ``gsstream.api.RenderSession``, narrowed to the A rows of the table; without a guard.
        views: of each iteration, the index of its training camera.
        comparisons: of each, what its render is compared with (``gsstream.api.Comparison``).
        waiting: of each, [A] bool, rows that take no part yet; None: all do.
        lr_factors: of each, a factor on the learning rates of latents and decoders.
        law: formulas of the gates (``gsstream.api.RoundedSigmoid``).
        price: formula of the penalty (``gsstream.api.GatePrice``).
        logits: [M] float32 of the gates; changed in place. state: their Adam moments, too. gate_lr: their rate.
        node_of: [A] int64 gate of each row.
        num_gaussians: N, the divisor of a mean price.
        rate_weight: loss per bit of latents behind open gates.
    """

    session: Any
    views: Sequence[int]
    comparisons: Sequence[Any]
    waiting: Sequence[torch.Tensor | None]
    lr_factors: Sequence[float]
    law: Any
    price: Any
    logits: torch.Tensor
    state: AdamState
    gate_lr: float
    node_of: torch.Tensor
    num_gaussians: int
    rate_weight: float


class ResidualTable(ABC):
    """The residual of A rows in one frame's optimisation: latents behind linear decoders, gated, trained by Adam.

    It is ``gsstream.residual.joint`` (rounding counts as the identity), the rate of ``gsstream.residual.rate`` and
    :meth:`RowOptimiser.step`, up to rounding, and a part may do all three at once. In every iteration ``rows``,
    ``pull`` and ``step`` are called in this order.
    """

    @property
    @abstractmethod
    def latents(self) -> torch.Tensor:
        """[A, L] leaf that requires grad: what waits in its ``grad`` is added to the gradient of the next step."""

    @property
    @abstractmethod
    def matrix(self) -> torch.Tensor:
        """[L, D] decoders as they are now."""

    @property
    @abstractmethod
    def curvature(self) -> torch.Tensor:
        """[A, L] running mean of the squared gradient of the latents."""

    @abstractmethod
    def rows(self, gates: torch.Tensor) -> Gaussians[torch.Tensor]:
        """Return the A rows with their residual behind ``gates`` [A], contiguous, without a graph."""

    @abstractmethod
    def pull(self, gradients: Gaussians[torch.Tensor], rate_weight: float) -> torch.Tensor:
        """Take the gradient by the rows that were returned last, and return that by their gates [A].

        Arguments:
            gradients: like the rows.
            rate_weight: loss per bit of the latents behind open gates; 0: bits cost nothing.
        """

    @abstractmethod
    def step(self, lr_factor: float = 1.0) -> None:
        """Make one step of Adam from what was pulled, and what waits on ``latents``.

        Arguments:
            lr_factor: on the learning rates of latents and decoders in this step, >= 0.

        Raises ShapeError where a gradient is not finite.
        """

    def run(self, work: ResidualPass) -> list[float]:
        """Make iterations in one call; return the losses of those that were made, from the first on.

        The others are left to whoever asks, who makes them by the calls above. A table that finds a fault (a value that
        is not finite) stops before that iteration, so that the calls above raise the error that says where it is.
        By default it makes none.

        Arguments:
            work: the iterations.
        """
        return []

    @abstractmethod
    def keep(self, rows: torch.Tensor) -> None:
        """Go on with these rows [K] of the A, and with the steps they have taken."""
