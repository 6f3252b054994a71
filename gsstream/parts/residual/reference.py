"""The residual's optimiser in plain torch, made of the functions beside it: the truth for faster ones."""

from __future__ import annotations

import torch

from gsstream.core.gaussians import Gaussians
from gsstream.parts.render.session import RenderSession
from gsstream.parts.residual.adam_state import RowParameters, RowSteps
from gsstream.parts.residual.decode import add_joint, decode_joint, join_features, joint_vjp
from gsstream.parts.residual.layout import JointLayout
from gsstream.parts.residual.optimiser import ResidualOptimiser


class JointResidualOptimiser(ResidualOptimiser[RenderSession]):
    """Calls the map of latents to attributes, its gradient, and the row optimiser's ``add_rate`` and ``step``."""

    def __init__(
        self,
        code: JointLayout,
        base: Gaussians[torch.Tensor],
        units: torch.Tensor,
        matrix: torch.Tensor,
        optimiser: RowSteps,
    ) -> None:
        self._code, self._base, self._units, self._optimiser = code, base, units, optimiser
        self._features = join_features(code, base)
        start = base.means.new_zeros(len(base), code.width)
        self._latents = RowParameters({"latents": start}, {"latents": code.lrs}, optimiser, ahead=True)
        self._decoders = RowParameters({"matrix": matrix}, {"matrix": code.decoder_lrs}, optimiser, ahead=True)

    @property
    def latents(self) -> torch.Tensor:
        return self._latents["latents"]

    @property
    def position(self) -> torch.Tensor:
        columns = self._code.latent.get("means")
        return self._features.new_zeros(len(self._base), 3) if columns is None else self.latents[:, columns]

    @property
    def matrix(self) -> torch.Tensor:
        return self._decoders["matrix"].detach()

    @property
    def curvature(self) -> torch.Tensor:
        return self._latents.moments("latents")["exp_avg_sq"]

    def forward(self, gates: torch.Tensor) -> Gaussians[torch.Tensor]:
        self._gates = gates
        self._change = decode_joint(self._code, self.latents.detach(), self.matrix, self._units)
        return add_joint(self._code, self._base, self._features, change=self._change, gates=gates)

    def backward(self, grad: Gaussians[torch.Tensor], rd_lambda: float | torch.Tensor) -> torch.Tensor:
        upstream = join_features(self._code, grad)
        back = joint_vjp(self._code, upstream, self._change, matrix=self.matrix, gates=self._gates, units=self._units)
        if isinstance(rd_lambda, torch.Tensor) or rd_lambda:
            latents, steps = self.latents.detach(), self._code.steps
            self._optimiser.add_rate(back.latents, latents, steps, gates=self._gates, weight=rd_lambda)
        self._grad = back
        return back.gates

    def step(self, lr_factor: float | torch.Tensor = 1.0) -> None:
        self._latents.step({"latents": self._grad.latents}, lr_factor)
        self._decoders.step({"matrix": self._grad.matrix}, lr_factor)

    def select_rows(self, rows: torch.Tensor) -> None:
        self._latents.select_rows(rows)
        self._base, self._features, self._units = self._base.rows(rows), self._features[rows], self._units[rows]
