"""What a structure promises."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from gsstream.core.errors import InputError
from gsstream.core.frame import PointCloud
from gsstream.core.hierarchy import Hierarchy
from gsstream.parts.structure.base import Structure
from gsstream.testing.cases import World, get_case
from gsstream.testing.compare import Behaviour, Outputs, finite, poisons_of
from gsstream.testing.registry import check

WORLDS = ("one", "two identical", "line", "cloud", "far", "tiny", "vast", "thin", "unseen")


def canonical(labels: torch.Tensor) -> list[int]:
    """Return labels renamed in the order of their first occurrence."""
    names: dict[int, int] = {}
    return [names.setdefault(int(label), len(names)) for label in labels]


def _built(part: Structure, case: World) -> Hierarchy:
    return part.build(case.gaussians, case.anchors)


@check("structure")
def check_structure_partition(part: Structure) -> None:
    """Every Gaussian has a node, int64 in [0, M); every node has a member or a child."""
    for name in (*WORLDS, "coincident"):
        case = get_case(name)
        forest = _built(part, case)
        n, m = len(case.gaussians), forest.num_nodes
        dtype = forest.node_of.dtype
        assert dtype == torch.int64, f"world {name!r}: node_of: expected int64, got {dtype}"
        assert tuple(forest.node_of.shape) == (n,), f"world {name!r}: node_of: expected shape [{n}]"
        low, high = int(forest.node_of.min()), int(forest.node_of.max())
        assert low >= 0 and high < m, f"world {name!r}: node_of: expected [0, {m}), got {low} to {high}"
        used = torch.zeros(m, dtype=torch.bool)
        used[forest.node_of] = True
        used[forest.parent[forest.parent != torch.arange(m)]] = True
        barren = (~used).nonzero()[:, 0]
        assert len(barren) == 0, f"world {name!r}: nodes without member or child: {barren[:5].tolist()} of {m}"


@check("structure")
def check_structure_forest(part: Structure) -> None:
    """A root is its own parent; following parents ends at a root within max(level) steps."""
    for name in WORLDS:
        forest = _built(part, get_case(name))
        m = forest.num_nodes
        forest_parent = forest.parent
        low, high = int(forest_parent.min()), int(forest_parent.max())
        assert low >= 0 and high < m, f"world {name!r}: parent: expected [0, {m}), got {low} to {high}"
        at = torch.arange(m)
        for _ in range(int(forest.level.max())):
            at = forest_parent[at]
        lost = (forest_parent[at] != at).nonzero()[:, 0]
        steps = int(forest.level.max())
        assert len(lost) == 0, f"world {name!r}: node {lost[:1].tolist()} reaches no root within {steps} steps"
        root = forest_parent == torch.arange(m)
        want = torch.where(root, torch.zeros_like(forest.level), forest.level[forest_parent] + 1)
        wrong = (forest.level != want).nonzero()[:, 0]
        assert len(wrong) == 0, (
            f"world {name!r}: level of node {int(wrong[0])}: expected {int(want[wrong[0]])}, "
            f"got {int(forest.level[wrong[0]])}"
        )


@check("structure")
def check_structure_label_free(part: Structure) -> None:
    """Permuting the Gaussians gives the same groups, whatever the nodes are called."""
    case = get_case("cloud")
    order = torch.randperm(len(case.gaussians), generator=torch.Generator().manual_seed(5))
    first = canonical(_built(part, case).node_of[order])
    second = canonical(_built(part, case.permuted(order)).node_of)
    apart = [i for i, (a, b) in enumerate(zip(first, second, strict=True)) if a != b]
    assert not apart, f"permuted Gaussians are grouped differently: {len(apart)} of {len(first)}, first row {apart[0]}"


@check("structure", trait="local")
def check_structure_locality(part: Structure) -> None:
    """Two members of one node are within one root cell of each other along every axis."""
    for name in ("line", "cloud", "unseen"):
        case = get_case(name)
        forest, cell = _built(part, case), float(case.anchors.cell_sizes[0])
        for node in range(forest.num_nodes):
            members = case.gaussians.means[forest.node_of == node]
            if len(members) == 0:
                continue
            span = float((members.amax(0) - members.amin(0)).max())
            assert span <= cell * (1 + 1e-5), (
                f"world {name!r}: members of node {node} are {span:.6g} apart; expected at most one root cell, "
                f"{cell:.6g} (1e-5 of it for float32 cell borders)"
            )


@check("structure", trait="idempotent")
def check_structure_idempotent(part: Structure) -> None:
    """Building again from the same Gaussians, also stored node by node, gives the same forest."""
    case = get_case("cloud")
    forest = _built(part, case)
    order = torch.argsort(forest.node_of, stable=True)
    again = _built(part, case.permuted(order))
    wrong = (again.node_of != forest.node_of[order]).nonzero()[:, 0]
    assert len(wrong) == 0, f"stored node by node, {len(wrong)} of {len(order)} rows got another node: resume drifts"
    assert torch.equal(again.parent, forest.parent), "parents differ after storing node by node"


@check("structure")
def check_structure_degenerate(part: Structure) -> None:
    """Coincident, collapsed and far clouds: a valid forest, at most N nodes per level, M = 0 for N = 0."""
    for name in ("coincident", "empty", "far", "tiny", "vast", "thin", "two identical"):
        case = get_case(name)
        forest = _built(part, case)
        forest.validate()
        deepest = int(forest.level.max()) + 1 if forest.num_nodes else 1
        bound = len(case.gaussians) * deepest
        assert forest.num_nodes <= bound, f"{name}: {forest.num_nodes} nodes; expected at most N x levels = {bound}"


@check("structure")
def check_structure_no_gradient(part: Structure) -> None:
    """Nothing it returns carries a gradient."""
    case = get_case("cloud")
    case = replace(case, gaussians=case.gaussians.map(lambda t: t.clone().requires_grad_(True)))
    forest = _built(part, case)
    carried = [name for name in ("node_of", "parent", "level") if getattr(forest, name).requires_grad]
    assert not carried, f"carries a gradient: {', '.join(carried)}"
    touched = [name for name, value in case.gaussians.items() if not value.requires_grad or value.grad is not None]
    assert not touched, f"requires_grad or .grad of the Gaussians changed: {', '.join(touched)}"


@check("structure")
def check_structure_seed(part: Structure) -> None:
    """Anchors are finite, levels index cell sizes, cells are positive and never grow; no points raise InputError."""
    for name in (*WORLDS, "coincident"):
        case = get_case(name)
        anchors = part.seed(case.points, case.cameras)
        n, levels, sizes = len(anchors.positions), len(anchors.cell_sizes), anchors.cell_sizes
        shapes = tuple(anchors.positions.shape), tuple(anchors.colors.shape)
        assert shapes == ((n, 3), (n, 3)), f"world {name!r}: expected positions and colors of [{n}, 3], got {shapes}"
        most = len(case.points) * levels
        assert 0 < n <= most, f"world {name!r}: expected 1 to {most} anchors, points times levels; got {n}"
        finite(f"world {name!r}: positions", anchors.positions)
        low, high = int(anchors.levels.min()), int(anchors.levels.max())
        assert low >= 0 and high < levels, f"world {name!r}: levels: expected [0, {levels}), got {low} to {high}"
        assert float(sizes.min()) > 0, f"world {name!r}: cell_sizes: expected positive, got {sizes.tolist()}"
        assert bool((sizes.diff() <= 0).all()), f"world {name!r}: cell_sizes grow: {sizes.tolist()}"
    nothing = PointCloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32), "nothing")
    try:
        part.seed(nothing, get_case("cloud").cameras)
    except InputError:
        return
    raise AssertionError("no points were accepted; expected InputError saying what to do")


@check("structure", trait="local")
def check_structure_translation(part: Structure) -> None:
    """Moved by whole root cells, along any axis, the Gaussians are grouped as before."""
    case = get_case("cloud")
    # Binary fractions: moving by a cell is exact, so nothing may fall on the other side of a border.
    means = torch.round(case.gaussians.means * 1024) / 1024
    anchors = replace(case.anchors, cell_sizes=torch.tensor([0.5, 0.25]), origin=torch.tensor([-2.0, -2.0, -2.0]))
    want: list[int] | None = None
    for cells in ((0, 0, 0), (2, 0, 0), (1, 3, 2)):
        moved = means + 0.5 * torch.tensor(cells, dtype=torch.float32)
        forest = part.build(replace(case.gaussians, means=moved), replace(anchors, positions=moved))
        got = canonical(forest.node_of)
        want = want or got
        apart = [row for row, (a, b) in enumerate(zip(got, want, strict=True)) if a != b]
        assert not apart, f"moved by {cells} root cells: {len(apart)} of {len(got)} rows are grouped differently"


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
