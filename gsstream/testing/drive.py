"""Calling a part the way the engine does: every output of every method, by name."""

from __future__ import annotations

from typing import Any

import torch

from gsstream.core.part import Part
from gsstream.gate.base import GateSampler
from gsstream.testing.cases import World
from gsstream.testing.registry import kind_of

Outputs = dict[str, torch.Tensor]


def outputs(part: Part, world: World) -> Outputs:
    """What ``part`` makes of a world, tensor by tensor."""
    return _DRIVERS[kind_of(part)](part, world)


def _structure(part: Any, world: World) -> Outputs:
    found: Outputs = {}
    if len(world.points):
        anchors = part.seed(world.points, world.cameras)
        for name in ("positions", "colors", "levels", "cell_sizes", "origin"):
            found[f"seed().{name}"] = getattr(anchors, name)
    forest = part.build(world.gaussians, world.anchors)
    return {**found, "build().node_of": forest.node_of, "build().parent": forest.parent, "build().level": forest.level}


def _confidence(part: Any, world: World) -> Outputs:
    return {"estimate()": part.estimate(world)}


def _propagation(part: Any, world: World) -> Outputs:
    return {"propagate()": part.propagate(world.logits, world.hierarchy)}


def _gate(part: GateSampler, world: World) -> Outputs:
    logits = part.init(world.logits)
    noise = draw(part, len(world.logits))
    found = {
        "init()": logits,
        "sample(None)": part.sample(logits, None),
        "open_probability()": part.open_probability(logits),
        "bound()": part.bound(logits),
    }
    return found if noise is None else {**found, "sample(noise)": part.sample(logits, noise)}


def draw(part: GateSampler, number: int, seed: int = 7) -> torch.Tensor | None:
    """Noise from a fresh generator."""
    return part.noise(number, torch.Generator().manual_seed(seed))


def _regularizer(part: Any, world: World) -> Outputs:
    opened = torch.sigmoid(_per_node(world))
    terms = part.penalty(opened, world.residual, world.hierarchy, len(world.logits))
    return {f"penalty()[{name!r}]": value for name, value in terms.items()}


def _per_node(world: World) -> torch.Tensor:
    """[M] one logit per node, whatever the order of the Gaussians."""
    return torch.linspace(-2, 2, world.hierarchy.num_nodes).to(world.logits.dtype)


_DRIVERS = {
    "structure": _structure,
    "confidence": _confidence,
    "propagation": _propagation,
    "gate": _gate,
    "regularizer": _regularizer,
}
