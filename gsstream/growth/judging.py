"""How wrong a scene is in a view, in units of its camera's noise, and who of the newborn makes it less so."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F

from gsstream.core.cameras import Cameras
from gsstream.core.context import FrameWork
from gsstream.core.gaussians import Gaussians
from gsstream.core.projection import inside, project
from gsstream.core.shapes import BoolArray, FloatArray, IntArray
from gsstream.growth.fitting import joined

#: Least noise of a pixel: recordings of 8 bits may repeat a still pixel exactly.
LEAST_NOISE = 1 / 255
#: Half side of the square of pixels around a newborn Gaussian in which its effect is looked for.
REACH = 3
#: Least part of the error around it, in a view, that a newborn Gaussian has to take away.
LEAST_SHARE = 0.02


class ErrorMap(NamedTuple):
    """One view: ``error`` [H, W] in units of the camera's noise, ``wrong`` [H, W] bool."""

    error: torch.Tensor
    wrong: torch.Tensor


class Landing(NamedTuple):
    """Points in a view: ``column``, ``row`` [P] pixels, ``depth`` [P] scene units, ``inside`` [P] bool."""

    column: FloatArray
    row: FloatArray
    depth: FloatArray
    inside: BoolArray


def error_map(work: FrameWork, scene: Gaussians[torch.Tensor], view: int, sigmas: float) -> ErrorMap:
    """Return where a view of a scene is wrong, among the pixels that changed.

    The camera's colour map is applied to the render, so the noise is that of its own pictures. Errors are means over
    3 x 3 pixels: one pixel beside an edge is off in every scene.

    Arguments:
        work: the frame.
        scene: N rows, raw values.
        view: index of a training camera.
        sigmas: error beyond which a pixel counts as wrong.
    """
    off = (work.shown(scene, view) - work.image(view)).permute(2, 0, 1)[None]
    mean = F.avg_pool2d(off, 3, 1, 1, count_include_pad=False)[0].abs().amax(0)
    error = mean / max(work.noise_sigma(view), LEAST_NOISE)
    return ErrorMap(error, (error > sigmas) & work.changed_pixels(view))


def landing(points: FloatArray, cameras: Cameras, view: int) -> Landing:
    """Return where points land in a view; those nearer than the near plane are not inside.

    Arguments:
        points: [P, 3] scene units.
        cameras: training cameras.
        view: index of one of them.
    """
    uv, depth = project(points, cameras, view)
    return Landing(uv[:, 0], uv[:, 1], depth, inside(uv, depth, cameras) & (depth > cameras.near))


def gains(
    scene: Gaussians[torch.Tensor], born: Gaussians[torch.Tensor], parents: IntArray, work: FrameWork, views: list[int]
) -> tuple[FloatArray, float]:
    """Return how much squared error, in units of noise, the newborn take away around each [B], and all together.

    A Gaussian whose surroundings get hardly better gains nothing: it is not worth its bytes.

    Arguments:
        scene: N rows, raw values, without the newborn.
        born: B rows, raw values.
        parents: [B] row of the scene that each is a half of, or -1.
        work: the frame.
        views: training cameras to judge by.
    """
    gain, total = np.zeros(len(born)), 0.0
    with_them = joined(without(scene, parents), born)
    for view in views:
        noise = max(work.noise_sigma(view), LEAST_NOISE)
        image = work.image(view)
        before = ((work.shown(scene, view) - image) / noise).square().sum(-1)
        less = before - ((work.shown(with_them, view) - image) / noise).square().sum(-1)
        total += float(less.sum())
        at = landing(born.means.numpy(), work.cameras, view)
        rows, columns = at.row[at.inside].astype(np.int64), at.column[at.inside].astype(np.int64)
        around, error = _around(less)[rows, columns], _around(before)[rows, columns]
        gain[at.inside] += around - LEAST_SHARE * error
    return gain, total


def without(scene: Gaussians[torch.Tensor], parents: IntArray) -> Gaussians[torch.Tensor]:
    """Return the scene without the rows that are parents; -1 is nobody."""
    staying = np.setdiff1d(np.arange(len(scene)), parents)
    return scene if len(staying) == len(scene) else scene.rows(torch.from_numpy(staying))


def _around(values: torch.Tensor) -> FloatArray:
    """[H, W] sums over the squares of pixels around each."""
    side = 2 * REACH + 1
    total = F.avg_pool2d(values[None, None], side, 1, REACH, divisor_override=1)
    return np.asarray(total[0, 0].numpy(), np.float64)
