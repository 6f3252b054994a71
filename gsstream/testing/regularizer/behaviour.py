"""Regularizers, for the common checks."""

from __future__ import annotations

import torch

from gsstream.parts.regularizer.base import Regularizer
from gsstream.testing.cases import World
from gsstream.testing.drive import Behaviour, Outputs, poisons_of


def outputs(part: Regularizer, world: World) -> Outputs:
    """Return every term. Nodes have the same probabilities whatever the order of the Gaussians."""
    opened = torch.sigmoid(torch.linspace(-2, 2, world.hierarchy.num_nodes).to(world.logits))
    terms = part.penalty(opened, world.residual, world.hierarchy, len(world.logits))
    return {f"penalty()[{name!r}]": value for name, value in terms.items()}


BEHAVIOUR = Behaviour(outputs, poisons_of("residual"), hands_on=True)
