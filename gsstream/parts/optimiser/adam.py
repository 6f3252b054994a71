"""Adam by rows in plain torch: the truth for faster implementations."""

from __future__ import annotations

from collections.abc import Mapping
from typing import final

import torch

from gsstream.core.deferred import require
from gsstream.core.errors import ShapeError
from gsstream.core.shapes import check_finite, check_shape
from gsstream.parts.optimiser.base import ADAM_BETAS, ADAM_EPS, MAX_GRADIENT, AdamState, RowOptimiser


@final
class ReferenceAdam(RowOptimiser):
    """Written for clarity; a dozen torch calls per table."""

    source = "Adam (Kingma and Ba 2015)"

    def step(
        self,
        values: Mapping[str, torch.Tensor],
        gradients: Mapping[str, torch.Tensor],
        states: Mapping[str, AdamState],
        lrs: Mapping[str, float | torch.Tensor],
    ) -> None:
        for name, gradient in gradients.items():
            value, state = values[name].detach(), states[name]
            check_shape(f"gradient of {name}", gradient, tuple(value.shape))
            _check_size(name, gradient)
            state.steps.add_(1)
            state.exp_avg.lerp_(gradient, 1 - ADAM_BETAS[0])
            state.exp_avg_sq.mul_(ADAM_BETAS[1]).addcmul_(gradient, gradient, value=1 - ADAM_BETAS[1])
            count = state.steps.double().reshape(-1, *[1] * (value.dim() - 1))
            first, second = (1 - beta**count for beta in ADAM_BETAS)
            denominator = state.exp_avg_sq.double().sqrt() / second.sqrt() + ADAM_EPS
            value.sub_((lrs[name] * state.exp_avg / first / denominator).to(value.dtype))


def _check_size(name: str, gradient: torch.Tensor) -> None:
    if gradient.device.type != "cpu":
        message = f"gradient of {name}: expected finite magnitudes up to {MAX_GRADIENT:g}, got one that is not"
        require((gradient.abs() <= MAX_GRADIENT).all(), lambda: ShapeError(message))
        return
    check_finite(f"gradient of {name}", gradient)
    bad = gradient.abs() > MAX_GRADIENT
    if bool(bad.any()):
        index = tuple(bad.nonzero()[0].tolist())
        raise ShapeError(
            f"gradient of {name}: expected magnitudes up to {MAX_GRADIENT:g}, got {float(gradient[index]):g} at index "
            f"{list(index)}; its square overflows float32. The optimisation has diverged, lower its learning rate"
        )
