"""How much the training images feel each value of a scene: the slopes of images of random signs.

The mean square of such a slope is the sum of the squared slopes of all pixels, so a pass over the cameras gives the
diagonal of the Gauss-Newton matrix (Hutchinson's estimate) without one pass for every pixel.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch

from gsstream.core.frame import Frame
from gsstream.core.gaussians import Gaussians
from gsstream.engine.fit.backward import pull_back
from gsstream.engine.fit.exposure import Exposure
from gsstream.render.base import Renderer


class Probe(NamedTuple):
    """One image of random signs, pulled back to the scene.

    ``slopes``: N rows, derivative of the sum of the signed pixels by every raw value. ``error``: mean squared error of
    that camera's image.
    """

    slopes: Gaussians[torch.Tensor]
    error: float


def probes(
    renderer: Renderer, gaussians: Gaussians[torch.Tensor], frame: Frame, exposure: Exposure | None,
    background: tuple[float, float, float], generator: torch.Generator, *, each: int,
) -> Iterator[Probe]:  # fmt: skip
    """Yield ``each`` probes of every camera.

    Arguments:
        renderer: of the run.
        gaussians: N rows, raw values, without gradients.
        frame: training images.
        exposure: colour maps of the cameras, or None.
        background: colour behind the scene.
        generator: of the signs.
        each: probes of a camera, at least 1; the relative deviation of a sum of their squares falls with its root.
    """
    session = renderer.open(gaussians, None, frame.cameras, background)
    for view in range(len(frame.cameras)):
        for _ in range(each):
            leaves = gaussians.map(lambda value: value.detach().clone().requires_grad_())
            image = session.render(view, leaves).image
            seen = image.detach() if exposure is None else exposure.apply(view, image.detach())
            error = float((seen - torch.from_numpy(frame.images[view])).square().mean())
            signs = torch.randint(0, 2, image.shape, generator=generator).to(image.dtype) * 2 - 1
            pull_back([image], [signs if exposure is None else exposure.pull(view, signs)])
            yield Probe(leaves.map(_slope), error)


def _slope(leaf: torch.Tensor) -> torch.Tensor:
    return torch.zeros_like(leaf) if leaf.grad is None else leaf.grad
