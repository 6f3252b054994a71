"""The parts of rings.py. They fail from frame 3 on, until the variable DRILL_MENDED is set."""

import os
from typing import final

import torch
from pydantic import Field

from gsstream.api import ConfidenceEstimator, GateSampler, PartConfig, Propagation, Regularizer, ShapeError

FIRST_BAD_FRAME = 3


def broken(index=FIRST_BAD_FRAME):
    return index >= FIRST_BAD_FRAME and "DRILL_MENDED" not in os.environ


@final
class Sound(GateSampler):
    """Always open (ours)."""

    class Config(PartConfig):
        share: float = Field(default=1.0, gt=0, le=1, description="nothing")

    num_levels = 1

    def init(self, logits):
        return logits.detach()

    def noise(self, num_nodes, generator):
        return None

    def sample(self, logits, noise):
        return torch.ones_like(logits)

    def open_probability(self, logits):
        return torch.ones_like(logits)

    def bound(self, logits):
        return logits


@final
class Unbuildable(GateSampler):
    """Needs a licence server (ours)."""

    def __init__(self, config=None):
        raise OSError("the licence server does not answer")

    num_levels = 1
    init = noise = sample = open_probability = bound = Sound.init


@final
class Raises(ConfidenceEstimator):
    """Divides by zero (ours)."""

    def estimate(self, context):
        if broken(context.index):
            1 / 0  # noqa: B018
        return torch.zeros(len(context.gaussians))


@final
class Undefined(ConfidenceEstimator):
    """NaN for the Gaussian in row 1 (ours)."""

    def estimate(self, context):
        logits = torch.zeros(len(context.gaussians))
        if broken(context.index):
            logits[1] = torch.nan
        return logits


@final
class Short(Propagation):
    """Forgets the last node, in every frame (ours)."""

    def propagate(self, logits, hierarchy):
        if logits.shape != (hierarchy.num_gaussians,):
            raise ShapeError("logits: wrong length")
        return logits[:-1] if broken() else logits


@final
class Tripping(GateSampler):
    """Refuses to sample, in every frame (ours)."""

    num_levels = 1
    init, noise, open_probability, bound = Sound.init, Sound.noise, Sound.open_probability, Sound.bound

    def sample(self, logits, noise):
        if broken():
            raise RuntimeError("out of luck")
        return torch.ones_like(logits)


@final
class Taxing(Regularizer):
    """An infinite price, in every frame (ours)."""

    def penalty(self, open_probability, residual, hierarchy, num_gaussians):
        return {"tax": torch.tensor(float("inf") if broken() else 0.0)}
