"""The fit of the cameras' colour maps while frame 0 is optimised.

Rigs are rarely colour-matched. Without this the Gaussians explain the differences between cameras with floaters and
view-dependent colour, and held-out views pay. The mean map is held at identity, so a camera that was not fitted (the
held-out ones) sees the scene as it is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from gsstream.parts.render.exposure import Exposure


@dataclass(frozen=True)
class ExposureFit:
    """Adam state of an exposure fit, per camera. Rows: the 9 + 3 coefficients."""

    exposure: Exposure
    first: torch.Tensor  # [C, 12]
    second: torch.Tensor  # [C, 12]
    steps: tuple[int, ...]

    @staticmethod
    def start(num_cameras: int, device: torch.device) -> ExposureFit:
        zeros = torch.zeros(num_cameras, 12, device=device)
        return ExposureFit(Exposure.identity(num_cameras).to(device), zeros, zeros, (0,) * num_cameras)

    def step(self, view: int, grad: torch.Tensor, lr: float, identity_weight: float) -> ExposureFit:
        """Make one Adam step of camera ``view``."""
        matrix, offset = self.exposure.matrix[view], self.exposure.offset[view]
        identity = torch.eye(3, device=matrix.device)
        grad = grad + identity_weight * torch.cat([(matrix - identity).flatten(), offset])
        count = self.steps[view] + 1
        first = 0.9 * self.first[view] + 0.1 * grad
        second = 0.999 * self.second[view] + 0.001 * grad.square()
        change = lr * (first / (1 - 0.9**count)) / ((second / (1 - 0.999**count)).sqrt() + 1e-10)
        steps = (*self.steps[:view], count, *self.steps[view + 1 :])
        exposure = Exposure(
            _put(self.exposure.matrix, view, matrix - change[:9].reshape(3, 3)),
            _put(self.exposure.offset, view, offset - 0.4 * change[9:]),
        )
        return ExposureFit(exposure, _put(self.first, view, first), _put(self.second, view, second), steps)

    def centered(self) -> ExposureFit:
        """Shift all maps so that their mean is identity: the gauge in which held-out cameras are compared."""
        matrix, offset = self.exposure.matrix, self.exposure.offset
        identity = torch.eye(3, device=matrix.device)
        centered = Exposure(matrix - matrix.mean(0) + identity, offset - offset.mean(0))
        return replace(self, exposure=centered)


def _put(values: torch.Tensor, row: int, value: torch.Tensor) -> torch.Tensor:
    out = values.clone()
    out[row] = value
    return out
