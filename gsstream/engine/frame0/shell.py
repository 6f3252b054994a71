"""The seeds behind the scene as Gaussians, beside those that a structure placed."""

from __future__ import annotations

import math

import torch

from gsstream.core.frame import Frame
from gsstream.core.gaussians import Gaussians
from gsstream.engine.frame0.optimise import isotropic
from gsstream.input.seeds.shell import find_shell, shell_points

#: Opacity of a seed of the shell.
OPACITY = 0.9


def with_shell(
    start: Gaussians[torch.Tensor], levels: torch.Tensor, frame: Frame
) -> tuple[Gaussians[torch.Tensor], torch.Tensor]:
    """Return the Gaussians and their levels with those of the shell behind them, which have the coarsest level."""
    points = shell_points(frame.as_float32().images, frame.cameras)
    scales = torch.full((len(points),), math.log(find_shell(frame.cameras).sigma))
    positions, colors = torch.from_numpy(points.xyz), torch.from_numpy(points.rgb)
    sphere = isotropic(positions, colors, scales, opacity=OPACITY, higher=start.shN.shape[1])
    coarsest = torch.full((len(points),), int(levels.min()), dtype=levels.dtype)
    both = {name: torch.cat([value, getattr(sphere, name)]) for name, value in start.items()}
    return Gaussians(**both), torch.cat([levels, coarsest])
