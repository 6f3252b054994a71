"""Sensitivity of the training images to each value of a scene: gradients of images of random signs.

The mean square of such a gradient is the sum of the squared gradients of all pixels, so a pass over the cameras gives
the diagonal of the Gauss-Newton matrix (Hutchinson's estimate) without one pass for every pixel.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from gsstream.core.frame import Frame
from gsstream.core.gaussians import Gaussians
from gsstream.parts.backend.base import Renderer
from gsstream.parts.render.backward import backward, gradient_of
from gsstream.parts.render.exposure import Exposure


@dataclass(frozen=True, slots=True)
class TrainingViews:
    """What the training cameras recorded of a frame, and how they would record a scene.

    Arguments:
        renderer: renderer of the run.
        frame: training images.
        exposure: colour maps of the cameras, or None.
        background: colour behind the scene.
    """

    renderer: Renderer
    frame: Frame
    exposure: Exposure | None
    background: tuple[float, float, float]

    def error(self, view: int, image: torch.Tensor) -> float:
        """Return the mean squared error of a camera's exposed render [H, W, 3]."""
        return float((image - torch.from_numpy(self.frame.image(view)).to(image.device)).square().mean())


class HutchinsonSample(NamedTuple):
    """One image of random signs, backpropagated to the scene.

    ``grad``: N rows, derivative of the sum of the signed pixels by every raw value. ``error``: mean squared error of
    that camera's image.
    """

    grad: Gaussians[torch.Tensor]
    error: float


def random_signs(like: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    """Return -1 or 1, each as often, for every value of ``like``.

    Eight are drawn at a time: one by one they take as long as a render of a large picture.
    """
    drawn = torch.randint(0, 256, (-(-like.numel() // 8),), generator=generator, dtype=torch.uint8)
    # The signs are bytes, a quarter of the size of the floats that they become: they may have to cross to a GPU.
    bits = torch.from_numpy(np.unpackbits(drawn.numpy(), count=like.numel())).to(like.device)
    return bits.to(like.dtype).mul_(2).sub_(1).reshape(like.shape)


def _pop_grad(leaf: torch.Tensor) -> torch.Tensor:
    """The gradient of a leaf, which has none afterwards."""
    gradient, leaf.grad = gradient_of(leaf), None
    return gradient


def hutchinson_samples(
    views: TrainingViews, gaussians: Gaussians[torch.Tensor], generator: torch.Generator, *, each: int
) -> Iterator[HutchinsonSample]:
    """Yield ``each`` Hutchinson samples of the image gradient for every camera."""
    cameras, exposure = views.frame.cameras, views.exposure
    session = views.renderer.open(gaussians, None, cameras, views.background)
    for view in range(len(cameras)):
        leaves = gaussians.map(lambda value: value.detach().clone().requires_grad_())
        image = session.render(view, leaves).image
        seen = image.detach() if exposure is None else exposure[view].apply(image.detach())
        error = views.error(view, seen)
        for number in range(each):
            signs = random_signs(image, generator)
            upstream = signs if exposure is None else exposure[view].vjp(signs)
            backward([image], [upstream], retain_graph=number < each - 1)
            yield HutchinsonSample(leaves.map(_pop_grad), error)
