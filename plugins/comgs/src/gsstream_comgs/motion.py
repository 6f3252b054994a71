"""Fitting key points to the images, and saying their field as rigid motions of small cells."""

from __future__ import annotations

import numpy as np
import torch

from gsstream.api import FitContext, IntArray, Motion, Scene, WrtRows
from gsstream.blocks import approximate_by_cells, neighbour_distance, pixel_size, rows_backward
from gsstream_comgs.influence import KeyPoints, apply_motion_field, field_of
from gsstream_comgs.settings import MotionSettings


def gradient_difference(work: FitContext) -> torch.Tensor:
    """Return [N]: the size of the change, from the frame before to this one, of the pull at every Gaussian's centre.

    It is that of the mean over the views of the gradient of the squared error; the render itself cancels.
    """
    total: torch.Tensor = torch.zeros(len(work.gaussians), 2)
    for view in range(len(work.cameras)):
        now = work.image(view)
        total += work.screen_gradient(view, 2 * (work.previous_image(view) - now) / now.numel()).gradient
    difference: torch.Tensor = total.norm(dim=1) / len(work.cameras)
    return difference


def fitted_motion(
    scene: Scene, work: FitContext, rows: IntArray, epochs: int, settings: MotionSettings, order: np.random.Generator
) -> Motion | None:
    """Return the motion of a frame; None where nothing moves."""
    difference = gradient_difference(work)[torch.from_numpy(rows)]
    number = min(settings.keypoints, int((difference > 0).sum()))
    if number == 0:
        return None
    pixel = pixel_size(scene.gaussians.means, work.cameras)
    side = float(np.float32(settings.pixels * pixel))
    chosen = torch.topk(difference, number).indices.sort().values
    base = scene.gaussians.rows(rows).map(torch.from_numpy)
    work.narrow(torch.from_numpy(rows))
    shape = _start(base.means[chosen], pixel)
    # Shifts and turns are trained in pixels: a turn of one unit moves what lies at the rim of the influence by a pixel.
    lever = pixel / float(shape.size.exp().mean())
    leaves = {name: torch.zeros(number, 3, requires_grad=True) for name in ("shift", "turn")}
    shapes = {"size": shape.size.requires_grad_(), "quat": shape.quat.requires_grad_()}
    adam = torch.optim.Adam([
        {"params": list(leaves.values()), "lr": settings.lr},
        {"params": list(shapes.values()), "lr": settings.lr_influence},
    ])  # fmt: skip

    def points() -> KeyPoints:
        return KeyPoints(shape.centre, leaves["shift"] * pixel, leaves["turn"] * lever, **shapes)

    views = len(work.cameras)
    for _ in range(epochs):
        for view in order.permutation(views):
            there = apply_motion_field(base, field_of(base.means, points()))
            rows_backward(there, work.loss_and_grad(int(view), WrtRows(there)).grad)
            adam.step()
            adam.zero_grad()
    with torch.no_grad():
        field = field_of(base.means, points())
    return approximate_by_cells(scene, rows, field.shift.numpy(), field.turn.numpy(), side, settings.step * pixel)


def _start(centres: torch.Tensor, pixel: float) -> KeyPoints:
    """Key points at rest; each influences what lies about as far as its neighbours do."""
    number = len(centres)
    spacing = neighbour_distance(centres).clamp_min(2 * pixel) if number > 1 else torch.full((1,), 10 * pixel)
    rest, quat = torch.zeros(number, 3), torch.zeros(number, 4)
    quat[:, 0] = 1
    return KeyPoints(centres.clone(), rest, rest, spacing.log()[:, None].repeat(1, 3), quat)
