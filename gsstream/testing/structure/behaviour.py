"""Structures, for the common checks."""

from __future__ import annotations

from gsstream.parts.structure.base import Structure
from gsstream.testing.cases import World
from gsstream.testing.drive import Behaviour, Outputs


def outputs(part: Structure, world: World) -> Outputs:
    """Return anchors and hierarchy."""
    found: Outputs = {}
    if len(world.points):
        anchors = part.seed(world.points, world.cameras)
        for name in ("positions", "colors", "levels", "cell_sizes", "origin"):
            found[f"seed().{name}"] = getattr(anchors, name)
    forest = part.build(world.gaussians, world.anchors)
    return {**found, "build().node_of": forest.node_of, "build().parent": forest.parent, "build().level": forest.level}


def poison(world: World, value: float) -> str:
    """Change one coordinate of one Gaussian to a value that none has."""
    world.gaussians.means[5, 0] = value
    return "one coordinate of one mean"


#: Node names may change with the order: check_structure_label_free compares partitions.
BEHAVIOUR = Behaviour(outputs, poison, keeps_precision=False, no_order="build")
