"""Frame 0 from coarse pictures to fine ones: most iterations are made where they are cheap.

Each level of the pyramid has learning rates of centres of its own: one schedule over all of them would have fallen to
nothing before the largest pictures, the only ones that show where fine texture lies, take part.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from gsstream.core.cameras import Cameras
from gsstream.core.gaussians import Gaussians
from gsstream.core.picture_size import WIDTH
from gsstream.engine.fit import constants
from gsstream.parts.backend.reference import BLUR
from gsstream.recipe.model import FirstFrame

#: Iterations of each level, the coarsest first, as a share of those that pictures of one size take.
SHARES = {1: (1.0,), 2: (0.325, 0.275), 3: (0.25, 0.25, 0.2)}
#: Learning rate of centres at the first and the last iteration of these levels, as a share of ``lr_means``. The
#: coarsest begins at 1, whatever their number, and the finest ends at twice the last rate of 3DGS.
RATES = ((1.0, 0.5), (0.5, 0.19), (0.38, None))


@dataclass(frozen=True, slots=True)
class PyramidLevel:
    """Iterations on pictures ``factor`` times smaller, after the first ``begin``.

    The learning rate of centres, in rig extents, goes from ``first_lr`` to ``last_lr``, log-linear.
    """

    factor: int
    begin: int
    iterations: int
    first_lr: float
    last_lr: float

    @property
    def end(self) -> int:
        """The iteration of the schedule that is this level's last."""
        return self.begin + self.iterations

    def lr_at(self, iteration: int) -> float:
        """Return the rate of centres in an iteration of the schedule, counted from 1."""
        fraction = (iteration - self.begin) / self.iterations
        if self.first_lr == 0:
            return 0.0
        return math.exp(math.log(self.first_lr) * (1 - fraction) + math.log(self.last_lr) * fraction)


@dataclass(frozen=True, slots=True)
class Pyramid:
    """Levels of picture size, the coarsest first; shares of the iterations at which growth ends and pruning happens."""

    levels: tuple[PyramidLevel, ...]
    densify_until: float
    prune_at: tuple[float, ...]

    @property
    def iterations(self) -> int:
        """Those of all levels together."""
        return self.levels[-1].end


def one_size(iterations: int, settings: FirstFrame) -> Pyramid:
    """Return the schedule on pictures of their own size alone."""
    level = PyramidLevel(
        factor=1,
        begin=0,
        iterations=iterations,
        first_lr=settings.lr_means,
        last_lr=settings.lr_means / constants.LR_MEANS_FALL,
    )
    return Pyramid((level,), constants.DENSIFY_UNTIL, constants.PRUNE_AT)


def plan_pyramid(width: int, iterations: int, settings: FirstFrame) -> Pyramid:
    """Return the schedule for pictures of this width: up to three levels, the coarsest at least 320 pixels wide.

    ``iterations``: number that pictures of one size would take. Too few iterations for several levels give one level.
    """
    count = min(len(RATES), 1 + max(0, int(math.log2(width / WIDTH)))) if settings.coarse_to_fine else 1
    shares = [round(share * iterations) for share in SHARES[count]]
    if count == 1 or min(shares) == 0:
        return one_size(iterations, settings)
    levels = list[PyramidLevel]()
    for number, (share, (first, last)) in enumerate(zip(shares, RATES[-count:], strict=True)):
        first_lr = settings.lr_means * (first if number else 1.0)
        last_lr = 2 * settings.lr_means / constants.LR_MEANS_FALL if last is None else last * settings.lr_means
        begin = levels[-1].end if levels else 0
        levels.append(
            PyramidLevel(
                factor=2 ** (count - 1 - number), begin=begin, iterations=share, first_lr=first_lr, last_lr=last_lr
            )
        )
    return Pyramid(tuple(levels), constants.PYRAMID_DENSIFY_UNTIL, constants.PYRAMID_PRUNE_AT)


def keep_widths(gaussians: Gaussians[torch.Tensor], cameras: Cameras, before: int, now: int) -> torch.Tensor:
    """Return log scales [N, 3] wider by the blur that larger pixels gave every Gaussian and smaller ones do not.

    The renderer adds ``BLUR`` pixels^2 to each Gaussian's variance on the screen. ``cameras`` are those of the pictures
    at their own size, ``before`` and ``now`` how many times smaller than these the pictures were and are.
    """
    focal = float(cameras.Ks[:, 0, 0].mean())
    means = gaussians.means.cpu().numpy()
    distances = np.median([np.linalg.norm(means - center, axis=1) for center in cameras.centers], 0)
    variance = torch.from_numpy(BLUR * (distances / focal) ** 2 * (before**2 - now**2)).to(gaussians.scales)
    return 0.5 * torch.log(torch.exp(2 * gaussians.scales) + variance[:, None])
