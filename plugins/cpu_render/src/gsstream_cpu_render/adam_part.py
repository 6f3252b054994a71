"""Adam by rows as a gsstream part."""

from __future__ import annotations

from collections.abc import Mapping
from typing import final

import torch

from gsstream.api import AdamState, Gaussians, JointLayout, ResidualOptimiser, RowOptimiser
from gsstream_cpu_render.adam_step import step_table
from gsstream_cpu_render.residual import CpuResidualOptimiser


@final
class CpuAdam(RowOptimiser):
    """Native and fused: one call per table, threaded where a table is large."""

    source = "Adam (Kingma and Ba 2015)"

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
    ) -> ResidualOptimiser:
        return CpuResidualOptimiser(code, base, units, matrix)
