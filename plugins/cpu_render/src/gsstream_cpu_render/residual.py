"""The residual of a frame's rows, fused and threaded (implements ``gsstream.backend.ResidualOptimiser``)."""

from __future__ import annotations

from dataclasses import replace
from typing import final

import torch

from gsstream.api import ATTRIBUTES, AnalyticGate, AnalyticPenalty, Gaussians
from gsstream.backend import ADAM_BETAS, ADAM_EPS, AdamState, JointLayout, ResidualEpoch, ResidualOptimiser
from gsstream_cpu_render import _native
from gsstream_cpu_render.adam_step import step_table
from gsstream_cpu_render.arrays import refuse, splats_of
from gsstream_cpu_render.native import native_scene
from gsstream_cpu_render.session import CpuSession


@final
class CpuResidualOptimiser(ResidualOptimiser[CpuSession]):
    """One native call for ``forward``, for ``backward`` and for an epoch; sums do not depend on the number of threads.

    Arguments:
        code: columns of the attributes.
        base: the A rows that the residual is added to.
        units: [A] unit of the position of each row, scene units.
        matrix: [L, D] decoders to start from.
    """

    def __init__(
        self, code: JointLayout, base: Gaussians[torch.Tensor], units: torch.Tensor, matrix: torch.Tensor
    ) -> None:
        self._code, self._base, self._units = code, base.map(torch.Tensor.contiguous), units.float().contiguous()
        self._native = _native.ResidualTable(_blocks(code), code.width, matrix.shape[1])
        self._latents = torch.zeros(len(base), code.width).requires_grad_()
        self._matrix = matrix.detach().clone()
        self._states = {
            "latents": AdamState.start(self._latents, ahead=True),
            "matrix": AdamState.start(self._matrix, ahead=True),
        }
        self._pending: tuple[torch.Tensor, torch.Tensor] | None = None

    @property
    def latents(self) -> torch.Tensor:
        return self._latents

    @property
    def position(self) -> torch.Tensor:
        columns = self._code.latent.get("means")
        return torch.zeros(len(self._units), 3) if columns is None else self._latents[:, columns]

    @property
    def matrix(self) -> torch.Tensor:
        return self._matrix

    @property
    def curvature(self) -> torch.Tensor:
        return self._states["latents"].exp_avg_sq

    def forward(self, gates: torch.Tensor) -> Gaussians[torch.Tensor]:
        self._gates = gates.float().contiguous()
        names = list(self._code.feature)
        base = {name: getattr(self._base, name) for name in names}
        out = {name: torch.empty_like(value) for name, value in base.items()}
        inputs = self._latents.detach(), self._matrix, self._code.steps, self._units, self._gates
        arrays = ([value.numpy() for value in some.values()] for some in (base, out))
        self._native.decode(*(value.numpy() for value in inputs), *arrays)
        return replace(self._base, **out)

    def backward(self, grad: Gaussians[torch.Tensor], rd_lambda: float | torch.Tensor) -> torch.Tensor:
        upstream = []
        for name in self._code.feature:
            value, like = getattr(grad, name), getattr(self._base, name)
            if value.shape != like.shape:
                refuse(f"gradient of {name}: expected shape {list(like.shape)}, got {list(value.shape)}")
            upstream.append(value.detach().contiguous().numpy())
        latents, matrix = torch.empty(self._latents.shape), torch.empty_like(self._matrix)
        by_gate = torch.empty(len(latents))
        results = [value.numpy() for value in (latents, matrix, by_gate)]
        inputs = self._latents.detach(), self._units, self._gates
        self._native.backward(*(value.numpy() for value in inputs), upstream, float(rd_lambda), *results)
        self._pending = latents, matrix
        return by_gate

    def step(self, lr_factor: float | torch.Tensor = 1.0) -> None:
        if self._pending is None:
            refuse("step: expected a backward before it, got none; call forward, backward and step in this order")
        latents, matrix = self._pending
        if self._latents.grad is not None:
            latents += self._latents.grad
            self._latents.grad = None
        self._pending = None
        lrs, decoder_lrs = lr_factor * self._code.lrs, lr_factor * self._code.decoder_lrs
        step_table("latents", self._latents.detach(), latents, state=self._states["latents"], lr=lrs)
        step_table("matrix", self._matrix, matrix, state=self._states["matrix"], lr=decoder_lrs)

    def run(self, epoch: ResidualEpoch[CpuSession]) -> list[torch.Tensor]:
        made: list[torch.Tensor] = []
        match epoch.gates.gate.form(), epoch.gates.regularizer.form():
            case AnalyticGate() as gate, AnalyticPenalty() as penalty:
                made = self._native_run(epoch, gate, penalty)
            case _:
                pass
        if len(made) == len(epoch.iterations):
            return made
        return made + super().run(epoch.after(len(made)))

    def _native_run(
        self, epoch: ResidualEpoch[CpuSession], gate: AnalyticGate, penalty: AnalyticPenalty
    ) -> list[torch.Tensor]:
        """Losses of the iterations up to one in which there is a fault; none where the session asks for single ones."""
        gates, iterations, code = epoch.gates, epoch.iterations, self._code
        epoch.begin(0)
        ready = epoch.session.fused_views([now.view for now in iterations], [now.target for now in iterations])
        if ready is None:
            return []
        views = [
            (*pair, None if now.frozen is None else now.frozen.numpy(), now.lr_factor)
            for pair, now in zip(ready, iterations, strict=True)
        ]
        divisor = max(gates.num_gaussians, 1) if penalty.mean else 1
        rule = [
            gate.temperature,
            gate.logit_offset,
            gate.levels,
            gate.open_logit,
            gate.bound,
            penalty.open_weight,
            penalty.displacement_weight,
            divisor,
        ]
        position = code.latent["means"].start if "means" in code.latent else -1
        tables = [
            _table(values, state)
            for values, state in (
                (gates.logits, gates.state),
                (self._latents, self._states["latents"]),
                (self._matrix, self._states["matrix"]),
            )
        ]
        rates = gates.lr, code.lrs.numpy(), code.decoder_lrs[:, 0].contiguous().numpy()
        losses = self._native.run(
            views,
            native_scene(splats_of(self._base)),
            [ATTRIBUTES.index(name) for name in code.feature],
            self._units.numpy(),
            code.steps.numpy(),
            gates.node_of.numpy(),
            [float(number) for number in rule],
            epoch.rd_lambda,
            position,
            *tables,
            *rates,
            (*ADAM_BETAS, ADAM_EPS),
        )
        return list(torch.tensor(losses, dtype=torch.float64))

    def select_rows(self, rows: torch.Tensor) -> None:
        self._base, self._units = self._base.rows(rows), self._units[rows]
        self._latents = self._latents.detach()[rows].requires_grad_()
        self._states["latents"] = self._states["latents"].rows(rows)
        self._pending = None


def _table(values: torch.Tensor, state: AdamState) -> tuple[object, ...]:
    """A table of values [n, ...] and the state of Adam, as the kernels take them."""
    rows = len(values)
    parts = [part.detach().numpy().reshape(rows, -1) for part in (values, state.exp_avg, state.exp_avg_sq)]
    return (*parts, state.steps.numpy(), state.ahead)


def _blocks(code: JointLayout) -> list[tuple[int, int, int, int, bool, bool]]:
    """Columns of each attribute; whether it is measured in units, and has a decoder."""
    blocks = []
    for name, rows in code.latent.items():
        columns = code.feature[name]
        decoder = bool(code.trained[rows, columns].any())
        size = rows.start, rows.stop - rows.start, columns.start, columns.stop - columns.start
        blocks.append((*size, name == "means", decoder))
    return blocks
