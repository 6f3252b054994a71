"""Adam by rows, which the renderer `cpu` brings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import final

import torch

from gsstream.api import Gaussians
from gsstream.backend import AdamState, JointLayout, ResidualOptimiser, RowOptimiser
from gsstream_cpu_render.adam_step import step_table
from gsstream_cpu_render.residual import CpuResidualOptimiser
from gsstream_cpu_render.session import CpuSession


@final
class CpuAdam(RowOptimiser):
    """Native and fused: one call per table, threaded where a table is large."""

    def step(
        self,
        values: Mapping[str, torch.Tensor],
        gradients: Mapping[str, torch.Tensor],
        states: Mapping[str, AdamState],
        lrs: Mapping[str, float | torch.Tensor],
    ) -> None:
        for name, gradient in gradients.items():
            step_table(name, values[name].detach(), gradient, state=states[name], lr=lrs[name])

    def residual_optimiser(
        self, code: JointLayout, base: Gaussians[torch.Tensor], units: torch.Tensor, matrix: torch.Tensor
    ) -> ResidualOptimiser[CpuSession]:
        return CpuResidualOptimiser(code, base, units, matrix)
