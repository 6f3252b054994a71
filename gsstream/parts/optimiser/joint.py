"""The residual of all attributes side by side, as one table: a few large operations instead of many small ones.

Latents of all attributes are the columns of one [A, L] table, their decoders the blocks of one [L, D] matrix (identity
where an attribute has no decoder), what changes the columns of one [A, D] table. The map is that of
:func:`gsstream.core.changes.apply_delta`, up to rounding.
"""

from __future__ import annotations

from typing import NamedTuple, final

import torch

from gsstream.core.gaussians import Gaussians
from gsstream.core.joint import JointLayout
from gsstream.parts.optimiser.rate import rate_gradient
from gsstream.parts.optimiser.residual import ResidualOptimiser
from gsstream.parts.optimiser.row_parameters import RowParameters
from gsstream.parts.optimiser.state import RowSteps


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
        decoded[:, code.feature["means"]] *= units[:, None]
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
        gated[:, code.feature["means"]] *= units[:, None]
    return JointGrad(gated @ matrix.T, (change.latents.T @ gated).mul_(code.trained), by_gate)


@final
class JointResidualOptimiser(ResidualOptimiser):
    """Calls the functions above, the rate's gradient and the optimiser's ``step``: the reference for faster ones."""

    def __init__(
        self,
        code: JointLayout,
        base: Gaussians[torch.Tensor],
        units: torch.Tensor,
        matrix: torch.Tensor,
        optimiser: RowSteps,
    ) -> None:
        self._code, self._base, self._units = code, base, units
        self._features = join_features(code, base)
        start = base.means.new_zeros(len(base), code.width)
        self._latents = RowParameters({"latents": start}, {"latents": code.lrs}, optimiser)
        self._decoders = RowParameters({"matrix": matrix}, {"matrix": code.decoder_lrs}, optimiser)

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

    def backward(self, grad: Gaussians[torch.Tensor], rd_lambda: float) -> torch.Tensor:
        upstream = join_features(self._code, grad)
        back = joint_vjp(self._code, upstream, self._change, matrix=self.matrix, gates=self._gates, units=self._units)
        if rd_lambda:
            back.latents.add_(rate_gradient(self.latents.detach(), self._code.steps, self._gates, rd_lambda))
        self._grad = back
        return back.gates

    def step(self, lr_factor: float = 1.0) -> None:
        self._latents.step({"latents": self._grad.latents}, lr_factor)
        self._decoders.step({"matrix": self._grad.matrix}, lr_factor)

    def select_rows(self, rows: torch.Tensor) -> None:
        self._latents.select_rows(rows)
        self._base, self._features, self._units = self._base.rows(rows), self._features[rows], self._units[rows]
