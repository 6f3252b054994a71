"""How much of a colour depends on where one looks from: do harmonics predict what a left-out camera sees?"""

from __future__ import annotations

import numpy as np
import torch

from gsstream.core.cameras import Cameras
from gsstream.core.gaussians import SH0
from gsstream.core.projection import inside, project
from gsstream.core.shapes import FloatArray
from gsstream.render.reference import evaluate_sh

#: Prior on every coefficient above degree 0, in observations. Frame 0 holds them back, too: their rate is a twentieth.
PRIOR = 10.0
#: Samples further than this many median deviations from their seed's colour are of something in front of it.
OUTLIER = 4.0
LEAST_VIEWS = 4
#: Squared error below which nothing is left to explain: a hundredth of that of rounding to 8 bits.
LEAST = 1e-8
#: So small that a colour of one coefficient stays away from the clamp at 0.
SMALL = 1e-3


def colour_gain(images: FloatArray, cameras: Cameras, xyz: FloatArray) -> tuple[float, float, float]:
    """Return, in dB, how much better degrees 1 to 3 predict a left-out camera's colour of a seed than degree 0.

    Each seed's colours in the cameras that see it are fitted by harmonics of the viewing direction, with a prior
    towards no dependence; the error is that of each camera predicted from the others (closed form of ridge regression).
    What an affine colour map per camera explains is taken off before. A degree with as many coefficients as there are
    cameras cannot be judged and gains 0.

    Arguments:
        cameras: training cameras.
        images: [C, H, W, 3] in [0, 1]. xyz: [P, 3] seeds, scene units.
    """
    colours, seen = _samples(images, cameras, xyz)
    kept = seen.sum(1) >= LEAST_VIEWS
    if not kept.any():
        return 0.0, 0.0, 0.0
    colours, seen, xyz = colours[kept], seen[kept], xyz[kept]
    colours = _without_response(colours, seen)
    seen = _without_occluders(colours, seen)
    basis = _harmonics(xyz, cameras.centers)
    errors = [_left_out_error(colours, seen, basis[..., : (degree + 1) ** 2]) for degree in range(4)]
    judged = [can_judge(degree, len(cameras)) and min(errors[0], errors[degree]) > LEAST for degree in range(4)]
    gains = [10 * float(np.log10(errors[0] / errors[d])) if judged[d] else 0.0 for d in (1, 2, 3)]
    return gains[0], gains[1], gains[2]


def can_judge(degree: int, cameras: int) -> bool:
    """Say whether a degree has fewer coefficients than there are cameras when one of them is left out."""
    return (degree + 1) ** 2 < cameras


def _samples(images: FloatArray, cameras: Cameras, xyz: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(colours [P, C, 3], seen [P, C] 0 or 1): the pixel that each seed falls on in each camera."""
    colours, seen = np.zeros((len(xyz), len(cameras), 3)), np.zeros((len(xyz), len(cameras)))
    for view in range(len(cameras)):
        uv, depth = project(xyz, cameras, view)
        mine = inside(uv, depth, cameras)
        column, row = uv[mine].astype(np.int64).T
        colours[mine, view] = images[view, row, column]
        seen[mine, view] = 1
    return colours, seen


def _mean(colours: FloatArray, seen: FloatArray) -> FloatArray:
    mean: FloatArray = (colours * seen[..., None]).sum(1) / np.maximum(seen.sum(1), 1)[:, None]
    return mean


def _without_response(colours: FloatArray, seen: FloatArray) -> FloatArray:
    """Colours with each camera's affine difference from the common colour (least squares, per channel) taken off."""
    common, out = _mean(colours, seen), colours.copy()
    for view in range(colours.shape[1]):
        mine = seen[:, view] > 0
        for channel in range(3):
            x, y = colours[mine, view, channel], common[mine, channel]
            if len(x) > 1 and np.ptp(x) > 0:
                slope, offset = np.polyfit(x, y, 1)
                out[mine, view, channel] = slope * x + offset
    return out


def _without_occluders(colours: FloatArray, seen: FloatArray) -> FloatArray:
    off = np.abs(colours - _mean(colours, seen)[:, None]).max(2)
    limit = OUTLIER * float(np.median(off[seen > 0]))
    kept: FloatArray = seen * (off <= limit)
    return kept


def _harmonics(xyz: FloatArray, centers: FloatArray) -> FloatArray:
    """[P, C, 16] real harmonics of the directions from cameras to seeds, the constant one being 1."""
    away = xyz[:, None] - centers[None]
    length = np.linalg.norm(away, axis=2, keepdims=True)
    directions = torch.from_numpy((away / np.where(length > 0, length, 1)).reshape(-1, 3))
    count = len(directions)
    basis = torch.ones(count, 16, dtype=torch.float64)
    for place in range(15):
        coefficients = torch.zeros(count, 15, 3, dtype=torch.float64)
        coefficients[:, place] = SMALL
        value = evaluate_sh(torch.zeros(count, 1, 3, dtype=torch.float64), coefficients, directions)
        basis[:, place + 1] = (value[:, 0] - 0.5) / (SMALL * SH0)
    shaped: FloatArray = basis.numpy().reshape(len(xyz), len(centers), 16)
    return shaped


def _left_out_error(colours: FloatArray, seen: FloatArray, basis: FloatArray) -> float:
    """Mean squared error of each sample predicted from the seed's other samples."""
    weighted = basis * seen[..., None]
    gram = np.einsum("pck,pcl->pkl", weighted, basis)
    prior = np.full(basis.shape[2], PRIOR)
    prior[0] = 1e-6
    inverse = np.linalg.inv(gram + np.diag(prior))
    fitted = np.einsum("pck,pkl,plm->pcm", basis, inverse, np.einsum("pck,pcm->pkm", weighted, colours), optimize=True)
    leverage = np.einsum("pck,pkl,pcl->pc", basis, inverse, basis, optimize=True)
    enough = (seen > 0) & (seen.sum(1)[:, None] >= LEAST_VIEWS) & (leverage < 1 - 1e-9)
    if not enough.any():
        return 0.0
    error = (colours - fitted) / np.where(enough, 1 - leverage, 1)[..., None]
    return float(np.square(error[enough]).mean())
