"""Structures, for the common checks."""

from __future__ import annotations

from gsstream.parts.structure.base import Structure
from gsstream.testing.cases import World
from gsstream.testing.drive import Behaviour, Outputs, poisons_of


def outputs(part: Structure, world: World) -> Outputs:
    """Return anchors and hierarchy."""
    found: Outputs = {}
    if len(world.points):
        anchors = part.seed(world.points, world.cameras)
        for name in ("positions", "colors", "levels", "cell_sizes", "origin"):
            found[f"seed().{name}"] = getattr(anchors, name)
    forest = part.build(world.gaussians, world.anchors)
    return {**found, "build().node_of": forest.node_of, "build().parent": forest.parent, "build().level": forest.level}


POISONS = poisons_of("gaussians.means", "gaussians.quats", "gaussians.scales", "points.xyz", "points.rgb")
#: Node names may change with the order: check_structure_label_free compares partitions.
BEHAVIOUR = Behaviour(outputs, POISONS, keeps_precision=False, no_order="build")
