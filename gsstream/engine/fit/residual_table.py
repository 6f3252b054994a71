"""The residual of a frame's rows made of the parts that define it: the truth for faster tables."""

from __future__ import annotations

import math
from typing import final

import torch

from gsstream.core.gaussians import Gaussians
from gsstream.core.joint import JointCode
from gsstream.engine.fit.row_table import RowTable
from gsstream.optimiser.base import ResidualTable, RowOptimiser
from gsstream.residual.joint import JointPullback, add_joint, decode_joint, join_features, pull_back_joint
from gsstream.residual.rate import rate_gradient


@final
class JointTable(ResidualTable):
    """Calls ``residual.joint``, ``residual.rate`` and the optimiser's ``step`` one after the other."""

    def __init__(
        self, code: JointCode, base: Gaussians[torch.Tensor], units: torch.Tensor, matrix: torch.Tensor,
        optimiser: RowOptimiser,
    ) -> None:  # fmt: skip
        self._code, self._base, self._units = code, base, units
        self._features = join_features(code, base)
        start = torch.zeros(len(base), code.width)
        self._latents = RowTable({"latents": start}, {"latents": code.lrs}, optimiser)
        self._decoders = RowTable({"matrix": matrix}, {"matrix": code.decoder_lrs}, optimiser)

    @property
    def latents(self) -> torch.Tensor:
        return self._latents["latents"]

    @property
    def matrix(self) -> torch.Tensor:
        return self._decoders["matrix"].detach()

    @property
    def curvature(self) -> torch.Tensor:
        return self._latents.moments("latents")["exp_avg_sq"]

    def rows(self, gates: torch.Tensor) -> Gaussians[torch.Tensor]:
        self._gates = gates
        self._change = decode_joint(self._code, self.latents.detach(), self.matrix, self._units)
        return add_joint(self._code, self._base, self._features, self._change, gates)

    def pull(self, gradients: Gaussians[torch.Tensor], rate_weight: float) -> torch.Tensor:
        upstream = join_features(self._code, gradients)
        back = pull_back_joint(self._code, upstream, self._change, self.matrix, self._gates, self._units)
        if rate_weight:
            back.latents.add_(rate_gradient(self.latents.detach(), self._code.steps, self._gates, rate_weight))
        self._pulled: JointPullback = back
        return back.gates

    def step(self, lr_factor: float = 1.0) -> None:
        self._latents.step({"latents": self._pulled.latents}, lr_factor)
        self._decoders.step({"matrix": self._pulled.matrix}, lr_factor)

    def keep(self, rows: torch.Tensor) -> None:
        self._latents.keep(rows)
        self._base, self._features, self._units = self._base.rows(rows), self._features[rows], self._units[rows]


def lr_factor(final: float, iteration: int, iterations: int) -> float:
    """Return the factor on the learning rates of a frame's residual at an iteration: it falls exponentially from 1.

    Arguments:
        final: factor at the last iteration, in (0, 1]; 1: the rates stay as they are.
        iteration: counted from 0.
        iterations: of the frame, as far as is known now; a frame of one iteration has the full rates.
    """
    return math.pow(final, iteration / max(1, iterations - 1))
