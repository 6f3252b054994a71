"""What changed since the scene was last right: per Gaussian, and per tile of every view."""

from __future__ import annotations

from typing import NamedTuple

import torch

from gsstream.api import FrameTools
from gsstream.backend import Renderer
from gsstream.blocks import count_per_tile
from gsstream_queen.settings import ChangeSettings

#: A pixel counts as changed where a render of the dynamic Gaussians alone reaches this alpha.
ALPHA = 0.5
#: Changed pixels that make a tile of 16 x 16 a changed one.
PIXELS = 40
#: Tiles by which the mask grows (published: 48 pixels).
DILATE = 1

TILE = 16
#: Inside the root of the colour distance, image units squared: no 0/0 where a pixel is exact.
EPSILON = 1e-12


class Change(NamedTuple):
    """``difference`` [N]: size of d(E_t - E_{t-1}) / d centre over the views, half image widths; ``seen`` [N] bool."""

    difference: torch.Tensor
    seen: torch.Tensor


def gradient_difference(work: FrameTools, settings: ChangeSettings) -> Change:
    """The view-space gradient difference (paper, Eq. 9).

    E compares an image with the scene as it was before the frame: their mean squared distance, or the mean Euclidean
    distance of pixel colours.
    """
    number, views = len(work.gaussians), len(work.cameras)
    vector, norms, seen = torch.zeros(number, 2), torch.zeros(number), torch.zeros(number, dtype=torch.bool)
    half = torch.tensor([work.cameras.width / 2, work.cameras.height / 2])
    for view in range(views):
        found = work.screen_gradient(view, _upstream(work, view, settings))
        gradient = found.gradient * half
        vector += gradient
        norms += gradient.norm(dim=1)
        seen |= found.visible
    return Change(vector.norm(dim=1) / views if settings.aggregate == "mean-vector" else norms, seen)


def _upstream(work: FrameTools, view: int, settings: ChangeSettings) -> torch.Tensor:
    """[H, W, 3] derivative of E_t - E_{t-1} with respect to the render of frame t-1."""
    if settings.loss == "mse":  # the render itself cancels
        change = work.image_change(view)
        return -2 * change / change.numel()
    now, before = work.image(view), work.previous_image(view)
    if torch.equal(now, before):
        return torch.zeros_like(now)
    shown = work.previous_render(view)
    return (_direction(shown, now) - _direction(shown, before)) / (now.shape[0] * now.shape[1])


def _direction(image: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """Gradient of the colour distance of every pixel."""
    difference = image - truth
    return difference / (difference.square().sum(-1, keepdim=True) + EPSILON).sqrt()


def changed_tiles(work: FrameTools, dynamic: torch.Tensor, renderer: Renderer) -> list[torch.Tensor]:
    """Per view [ceil(H / 16), ceil(W / 16)] bool: where the dynamic Gaussians [N] bool, drawn alone, are opaque."""
    cameras = work.cameras
    rows, columns = -(-cameras.height // TILE), -(-cameras.width // TILE)
    if not bool(dynamic.any()):
        return [torch.zeros(rows, columns, dtype=torch.bool)] * len(cameras)
    alone = work.gaussians.rows(dynamic)
    masks = []
    for view in range(len(cameras)):
        with torch.no_grad():
            alpha = renderer.render(alone, cameras, view, (0.0, 0.0, 0.0)).alpha
        count, size = count_per_tile(alpha > ALPHA)
        changed = (count >= size * PIXELS / TILE**2).float()[None, None]
        kernel = 2 * DILATE + 1
        masks.append(torch.nn.functional.max_pool2d(changed, kernel, 1, DILATE)[0, 0] > 0)
    return masks
