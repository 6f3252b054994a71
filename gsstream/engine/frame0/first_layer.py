"""Which Gaussians stand first in a key packet (``codec.first_layer``): those that the images would miss most."""

from __future__ import annotations

import torch

from gsstream.core.frame import Frame
from gsstream.core.gaussians import Gaussians
from gsstream.core.rng import Rng
from gsstream.core.shapes import BoolArray
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.frame0.hutchinson import TrainingViews
from gsstream.engine.frame0.prune import removal_errors
from gsstream.parts.render.exposure import Exposure


def first_layer_mask(
    assembly: Assembly, gaussians: Gaussians[torch.Tensor], frame: Frame, exposure: Exposure | None, rng: Rng
) -> BoolArray | None:
    """Return the choice [N] bool of the Gaussians that come first, or None where the packet is to have no layers."""
    share = assembly.recipe.codec.first_layer
    if share == 1 or len(gaussians) == 0:
        return None
    generator = rng.stream("first layer", frame.index)
    views = TrainingViews(assembly.renderer, frame, exposure, assembly.background)
    # One probe for each camera is enough to order the Gaussians: with four the first layer shows 0.1 dB more, and a
    # large picture takes a second longer.
    errors, _ = removal_errors(views, gaussians, generator, probes=1)
    return largest_error_mask(errors, share)


def largest_error_mask(errors: torch.Tensor, share: float) -> BoolArray:
    """Return the choice [N] bool of the rows with the largest errors; of equal ones those that stand first."""
    order = torch.argsort(errors, descending=True, stable=True)
    chosen = torch.zeros(len(errors), dtype=torch.bool)
    chosen[order[: max(1, round(share * len(errors)))]] = True
    choice: BoolArray = chosen.numpy()
    return choice
