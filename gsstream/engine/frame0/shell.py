"""The seeds behind the scene as Gaussians, beside those that a structure placed."""

from __future__ import annotations

import math

import torch

from gsstream.core.frame import Frame
from gsstream.core.gaussians import Gaussians
from gsstream.input.seeds.shell import find_shell, shell_points
from gsstream.parts.growth.fitting import concat_gaussians
from gsstream.parts.render.activations import logit, rgb_to_sh0

#: Opacity of a seed of the shell.
OPACITY = 0.9


def with_shell(
    start: Gaussians[torch.Tensor], levels: torch.Tensor, frame: Frame
) -> tuple[Gaussians[torch.Tensor], torch.Tensor]:
    """Return the Gaussians and their levels with those of the shell behind them, which have the coarsest level."""
    points = shell_points(frame.images, frame.cameras)
    count = len(points)
    quats = torch.zeros(count, 4)
    quats[:, 0] = 1
    sphere = Gaussians(
        means=torch.from_numpy(points.xyz),
        quats=quats,
        scales=torch.full((count, 3), math.log(find_shell(frame.cameras).sigma)),
        opacities=torch.full((count,), logit(OPACITY)),
        sh0=rgb_to_sh0(torch.from_numpy(points.rgb)),
        shN=torch.zeros(count, *start.shN.shape[1:]),
    )
    coarsest = torch.full((count,), int(levels.min()), dtype=levels.dtype)
    return concat_gaussians(start, sphere), torch.cat([levels, coarsest])
