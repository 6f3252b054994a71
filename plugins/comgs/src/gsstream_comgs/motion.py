"""Motion by key points: the fit to the images, and the rigid motions of small cells that come near to their field."""

from __future__ import annotations

from typing import Any, final

import numpy as np
import torch
from pydantic import Field

from gsstream.api import FitContext, Motion, MotionPart, MotionTraits, PartConfig, Rng, Scene, WrtRows
from gsstream.blocks import (
    approximate_by_cells,
    enlargement,
    neighbour_distance,
    pixel_size,
    rows_backward,
    transform_rows,
)
from gsstream_comgs.influence import KeyPoints, field_of

#: Least share of the views that show a Gaussian in which it must lie in changed tiles, to take part.
VOTES = 0.75
#: Adam's learning rate of what a key point influences: log sizes and a quaternion.
LR_INFLUENCE = 0.02
#: Side of the cells that are sent, pixels at a width of 320.
CELL = 6.0


def gradient_difference(work: FitContext) -> torch.Tensor:
    """Return [N]: how much the gradient by every Gaussian's 2-D mean changed since the frame before.

    The gradient is the mean over the views of the gradient of the squared error; the render itself cancels.
    """
    total: torch.Tensor = torch.zeros(len(work.gaussians), 2)
    for view in range(len(work.cameras)):
        change = work.image_change(view)
        total += work.screen_gradient(view, -2 * change / change.numel()).gradient
    difference: torch.Tensor = total.norm(dim=1) / len(work.cameras)
    return difference


@final
class KeyPointMotion(MotionPart):
    """Moves Gaussians by a few key points, each with a rigid motion and an ellipsoid (ComGS, NeurIPS 2025).

    The packet holds the rigid motions of small cells that come nearest to the field of the key points.
    """

    source = "ComGS (NeurIPS 2025)"
    processor_only = "it moves rows by numpy"
    traits = MotionTraits(finds_motion=True, momentum=0.0)

    class Config(PartConfig):
        keypoints: int = Field(default=200, ge=1, le=10_000, description="key points in a frame at most")
        epochs: int = Field(default=8, ge=1, le=1000, description="passes over the training cameras")
        lr: float = Field(default=0.25, gt=0, le=10, description="step of shifts and turns, pixels at a width of 320")
        step: float = Field(default=0.1, gt=0, le=10, description="quantisation step, pixels")

    def propose(self, scene: Scene, work: FitContext, rng: Rng, memory: Any = None) -> tuple[Motion, ...]:
        rows = work.changed_rows(VOTES).nonzero()[:, 0]
        difference = gradient_difference(work.everywhere())[rows]
        number = min(self.config.keypoints, int((difference > 0).sum()))
        if number == 0:
            return ()
        chosen = torch.topk(difference, number).indices.sort().values
        motion = _fitted(scene, work, rows, chosen=chosen, settings=self.config, order=rng.numpy("comgs", work.index))
        return () if motion is None else (motion,)


def _fitted(
    scene: Scene,
    work: FitContext,
    rows: torch.Tensor,
    chosen: torch.Tensor,
    settings: KeyPointMotion.Config,
    order: np.random.Generator,
) -> Motion | None:
    """The motion that ``chosen`` of the rows [A], as key points, fit to the images."""
    number, epochs = len(chosen), work.scaled(settings.epochs)
    pixel, wide = pixel_size(scene.gaussians.means, work.cameras), enlargement(work.cameras.width)
    side = float(np.float32(CELL * wide * pixel))
    base = scene.gaussians.rows(rows.numpy()).map(torch.from_numpy)
    work.narrow(rows)
    shape = _start(base.means[chosen], pixel)
    # Shifts and turns are trained in pixels: a turn of one unit moves what lies at the rim of the influence by a pixel.
    lever = pixel / float(shape.size.exp().mean())
    leaves = {name: torch.zeros(number, 3, requires_grad=True) for name in ("shift", "turn")}
    shapes = {"size": shape.size.requires_grad_(), "quat": shape.quat.requires_grad_()}
    adam = torch.optim.Adam(
        [
            {"params": list(leaves.values()), "lr": settings.lr * wide},
            {"params": list(shapes.values()), "lr": LR_INFLUENCE},
        ]
    )

    def points() -> KeyPoints:
        return KeyPoints(shape.centre, leaves["shift"] * pixel, leaves["turn"] * lever, **shapes)

    views = len(work.cameras)
    for _ in range(epochs):
        for view in order.permutation(views):
            field = field_of(base.means, points())
            there = transform_rows(base, field.shift, field.turn)
            rows_backward(there, work.loss_and_grad(int(view), WrtRows(there)).grad)
            adam.step()
            adam.zero_grad()
    with torch.no_grad():
        field = field_of(base.means, points())
    step = settings.step * pixel
    moves = field.shift.numpy(), field.turn.numpy()
    return approximate_by_cells(scene, rows.numpy(), work.shell_rows, *moves, side, step)


def _start(centres: torch.Tensor, pixel: float) -> KeyPoints:
    """Key points at rest; each influences what lies about as far as its neighbours do."""
    number = len(centres)
    spacing = neighbour_distance(centres).clamp_min(2 * pixel) if number > 1 else torch.full((1,), 10 * pixel)
    rest, quat = torch.zeros(number, 3), torch.zeros(number, 4)
    quat[:, 0] = 1
    return KeyPoints(centre=centres.clone(), shift=rest, turn=rest, size=spacing.log()[:, None].repeat(1, 3), quat=quat)
