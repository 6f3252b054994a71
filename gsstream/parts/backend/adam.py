"""Adam by rows in plain torch: the truth for faster implementations."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from functools import partial

import torch

from gsstream.core.deferred import are_deferred, require
from gsstream.core.errors import ShapeError
from gsstream.core.shapes import check_finite, check_shape
from gsstream.parts.backend.row_optimiser import RowOptimiser
from gsstream.parts.residual.adam_state import ADAM_BETAS, ADAM_EPS, MAX_GRADIENT, AdamState

#: Number of steps from which on both corrections are 1 in float32.
SATURATED = 1 << 15


class ReferenceAdam(RowOptimiser):
    """A dozen torch calls per table, on its device."""

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
            # Where an error is raised at once, the table stays as it was.
            if not (are_deferred() and self.looks(value)):
                _check_size(name, gradient)
            state.steps.add_(1)
            is_well = self.move(value, gradient, state, bias_corrections(value.device), lr=lrs[name])
            if is_well is not None:
                require(is_well, partial(_too_large, name))

    def looks(self, value: torch.Tensor) -> bool:
        """Say whether :meth:`move` looks at the gradient of such a table itself, in the same visit."""
        return False

    def move(
        self,
        value: torch.Tensor,
        gradient: torch.Tensor,
        state: AdamState,
        corrections: torch.Tensor,
        lr: float | torch.Tensor,
    ) -> torch.Tensor | None:
        """Move a table [n, ...] and both of its moments in place.

        Arguments:
            value: the table. gradient: of its shape. state: its steps count this one already.
            corrections: :func:`bias_corrections`. lr: a number, or a tensor that broadcasts to the table.

        Returns:
            [] bool, that no gradient is beyond MAX_GRADIENT, where this looks; None: it was looked at before.
        """
        state.exp_avg.lerp_(gradient, 1 - ADAM_BETAS[0])
        state.exp_avg_sq.mul_(ADAM_BETAS[1]).addcmul_(gradient, gradient, value=1 - ADAM_BETAS[1])
        mean, (first, ahead, second) = state.exp_avg, corrections[state.steps.clamp_max(len(corrections) - 1)].unbind(1)
        if state.ahead:
            mean, first = torch.lerp(mean, gradient, 1 - ADAM_BETAS[0]), ahead
        wide = (-1, *[1] * (value.dim() - 1))
        step, denominator = mean * first.reshape(wide), state.exp_avg_sq.sqrt() + second.reshape(wide)
        if isinstance(lr, torch.Tensor):
            value.addcdiv_(step.mul_(lr), denominator, value=-1)
        else:
            value.addcdiv_(step, denominator, value=-lr)
        return None


@functools.cache
def bias_corrections(device: torch.device) -> torch.Tensor:
    """Return [SATURATED + 1, 3] by the number n of steps: factors on the first moment, and what stands for epsilon.

    They are sqrt(1 - b2^n) / (1 - b1^n), the same with b1^(n + 1) for steps that look ahead, and epsilon
    sqrt(1 - b2^n), which is Adam's step with the correction of the second moment taken out of the fraction. They are
    looked up, because to compute them takes ten times as many operations, in double precision. Those of no step are
    never used.
    """
    steps = torch.arange(SATURATED + 1, dtype=torch.float64).clamp_min(1)
    first, ahead, second = 1 - ADAM_BETAS[0] ** steps, 1 - ADAM_BETAS[0] ** (steps + 1), 1 - ADAM_BETAS[1] ** steps
    root = second.sqrt()
    return torch.stack([root / first, root / ahead, ADAM_EPS * root], 1).float().to(device)


def _too_large(name: str) -> ShapeError:
    return ShapeError(f"gradient of {name}: expected finite magnitudes up to {MAX_GRADIENT:g}, got one that is not")


def _check_size(name: str, gradient: torch.Tensor) -> None:
    if gradient.device.type != "cpu":
        largest = torch.linalg.vector_norm(gradient, torch.inf) if gradient.numel() else gradient.new_zeros(())
        require(largest <= MAX_GRADIENT, partial(_too_large, name))
        return
    check_finite(f"gradient of {name}", gradient)
    bad = gradient.abs() > MAX_GRADIENT
    if bool(bad.any()):
        index = tuple(bad.nonzero()[0].tolist())
        raise ShapeError(
            f"gradient of {name}: expected magnitudes up to {MAX_GRADIENT:g}, got {float(gradient[index]):g} at index "
            f"{list(index)}; its square overflows float32. The optimisation has diverged, lower its learning rate"
        )
