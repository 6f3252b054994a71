"""What Gaussians cost besides errors in the pictures: opacity, size, and the pixels that they cover. Ours.

Pictures alone do not ask for small Gaussians: many wide and faint ones on top of each other show what a few small ones
show. Every covered pixel is blended in every iteration and whenever the stream is drawn, though. With a price on the
number of Gaussians, a pixel of a large picture blends three tenths fewer of them, at nearly equal quality
(docs/results/extremes.md).
"""

from __future__ import annotations

import math

import torch

from gsstream.core.cameras import Cameras
from gsstream.core.gaussians import Gaussians
from gsstream.engine.fit import constants
from gsstream.parts.backend.reference import ALPHA_CUT

#: Squared distance, in squared scene units, below which a Gaussian is taken to stand at it.
NEAREST2 = 1e-12


def add_penalty_grad(
    gradients: Gaussians[torch.Tensor],
    scene: Gaussians[torch.Tensor],
    cameras: Cameras,
    view: int,
    center: torch.Tensor,
    extent: float,
    area_price: float,
) -> None:
    """Add to the gradients those of the mean opacity, the mean scale and the pixels that are covered, without a graph.

    A Gaussian of scales a, b, c and opacity o covers at distance d, in the mean over all directions, about
    2 pi ln(255 o) (ab + ac + bc) / 3 (f / d)^2 pixels with more than 1 / 255 of its light. ``area_price`` is for one
    Gaussian that covers the picture, which is for one Gaussian more that each pixel blends. Only what the view drew
    pays: else a Gaussian that one camera sees would pay for all of them, and what few cameras see would wear away.

    Arguments:
        gradients: [N] by the view's loss, of which ``scales`` and ``opacities`` are added to, in place. A row was drawn
            where that of its opacity is not 0.
        scene: [N] raw values.
        cameras: of the pictures that are compared.
        view: camera that covered pixels are counted in.
        center: [3] where it stands, on the device of the scene: copied in every iteration, it would be waited for.
        extent: of the rig, in scene units, above 0.
        area_price: in units of the loss, at least 0; 0: what is covered has no price.
    """
    count = max(1, len(scene))
    drawn = gradients.opacities != 0
    opacity, sizes = scene.opacities.sigmoid(), scene.scales.exp()
    gradients.opacities.add_(opacity * (1 - opacity), alpha=constants.OPACITY_PENALTY / count)
    gradients.scales.add_(sizes, alpha=constants.SCALE_PENALTY / (3 * count * extent))
    if area_price == 0:
        return
    # Every axis has a row of its own, because tables whose columns are the axes are slow to multiply.
    away = _by_axis(scene.means) - center[:, None]
    x2, y2, z2 = away * away
    focal2 = float(cameras.Ks[view, 0, 0] * cameras.Ks[view, 1, 1])
    per_area = 2 * math.pi / 3 * focal2 / (cameras.width * cameras.height) * drawn / (x2 + y2 + z2).clamp_min(NEAREST2)
    axes = _by_axis(sizes)
    # By the logarithm of a scale: d(ab + ac + bc) / d(ln a) = a (b + c). Nothing covers more than the picture.
    covered = (axes[0] + axes[1] + axes[2] - axes).mul_(axes).mul_(per_area).clamp_(max=1.0)
    # By the logit of the opacity: d(ln o) / d(logit o) = 1 - o, and the areas of the axes count each area twice.
    gradients.opacities.addcmul_(covered[0] + covered[1] + covered[2], 1 - opacity, value=area_price / 2)
    covered *= (1 / ALPHA_CUT * opacity).clamp_min(1.0).log()
    gradients.scales.add_(covered.T, alpha=area_price)


def _by_axis(values: torch.Tensor) -> torch.Tensor:
    """[3, N] of [N, 3], in a third of the time of a transposed copy."""
    return torch.stack(values.unbind(1))
