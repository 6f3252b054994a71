"""The residual of a frame's rows, fused and threaded (implements ``gsstream.api.ResidualTable``)."""

from __future__ import annotations

from dataclasses import replace
from typing import final

import torch

from gsstream.api import AdamState, Gaussians, JointCode, ResidualTable
from gsstream_cpu_render import _native
from gsstream_cpu_render.adam_step import step_table
from gsstream_cpu_render.checks import refuse


@final
class CpuResidualTable(ResidualTable):
    """One native call for each of ``rows`` and ``pull``; sums over rows do not depend on the number of threads.

    Arguments:
        code: columns of the attributes.
        base: the A rows that the residual is added to.
        units: [A] unit of the position of each row, scene units.
        matrix: [L, D] decoders to start from.
    """

    def __init__(
        self, code: JointCode, base: Gaussians[torch.Tensor], units: torch.Tensor, matrix: torch.Tensor
    ) -> None:
        self._code, self._base, self._units = code, base.map(torch.Tensor.contiguous), units.float().contiguous()
        self._native = _native.ResidualTable(_blocks(code), code.width, matrix.shape[1])
        self._latents = torch.zeros(len(base), code.width).requires_grad_()
        self._matrix = matrix.detach().clone()
        self._states = {"latents": AdamState.start(self._latents), "matrix": AdamState.start(self._matrix)}
        self._pulled: tuple[torch.Tensor, torch.Tensor] | None = None

    @property
    def latents(self) -> torch.Tensor:
        return self._latents

    @property
    def matrix(self) -> torch.Tensor:
        return self._matrix

    @property
    def curvature(self) -> torch.Tensor:
        return self._states["latents"].exp_avg_sq

    def rows(self, gates: torch.Tensor) -> Gaussians[torch.Tensor]:
        self._gates = gates.float().contiguous()
        names = list(self._code.feature)
        base = {name: getattr(self._base, name) for name in names}
        out = {name: torch.empty_like(value) for name, value in base.items()}
        inputs = self._latents.detach(), self._matrix, self._code.steps, self._units, self._gates
        arrays = ([value.numpy() for value in some.values()] for some in (base, out))
        self._native.decode(*(value.numpy() for value in inputs), *arrays)
        return replace(self._base, **out)

    def pull(self, gradients: Gaussians[torch.Tensor], rate_weight: float) -> torch.Tensor:
        upstream = []
        for name in self._code.feature:
            value, like = getattr(gradients, name), getattr(self._base, name)
            if value.shape != like.shape:
                refuse(f"gradient of {name}: expected shape {list(like.shape)}, got {list(value.shape)}")
            upstream.append(value.detach().contiguous().numpy())
        latents, matrix = torch.empty(self._latents.shape), torch.empty_like(self._matrix)
        by_gate = torch.empty(len(latents))
        results = [value.numpy() for value in (latents, matrix, by_gate)]
        inputs = self._latents.detach(), self._units, self._gates
        self._native.pull(*(value.numpy() for value in inputs), upstream, rate_weight, *results)
        self._pulled = latents, matrix
        return by_gate

    def step(self, lr_factor: float = 1.0) -> None:
        if self._pulled is None:
            refuse("step: expected a pull before it, got none; call rows, pull and step in this order")
        latents, matrix = self._pulled
        if self._latents.grad is not None:
            latents += self._latents.grad
            self._latents.grad = None
        self._pulled = None
        lrs, decoder_lrs = lr_factor * self._code.lrs, lr_factor * self._code.decoder_lrs
        step_table("latents", self._latents.detach(), latents, self._states["latents"], lrs)
        step_table("matrix", self._matrix, matrix, self._states["matrix"], decoder_lrs)

    def keep(self, rows: torch.Tensor) -> None:
        self._base, self._units = self._base.rows(rows), self._units[rows]
        self._latents = self._latents.detach()[rows].requires_grad_()
        state = self._states["latents"]
        self._states["latents"] = AdamState(state.exp_avg[rows], state.exp_avg_sq[rows], state.steps[rows])
        self._pulled = None


def _blocks(code: JointCode) -> list[tuple[int, int, int, int, bool, bool]]:
    """Columns of each attribute; whether it is measured in units, and has a decoder."""
    blocks = []
    for name, rows in code.latent.items():
        columns = code.feature[name]
        decoder = bool(code.trained[rows, columns].any())
        size = rows.start, rows.stop - rows.start, columns.start, columns.stop - columns.start
        blocks.append((*size, name == "means", decoder))
    return blocks
