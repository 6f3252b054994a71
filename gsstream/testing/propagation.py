"""What a propagation promises. It maps logits to logits."""

from __future__ import annotations

from dataclasses import replace

import torch

from gsstream.core.hierarchy import Hierarchy, tree_roots
from gsstream.parts.propagation.base import Propagation
from gsstream.testing.cases import World, flat, get_case
from gsstream.testing.compare import ROUNDING, Behaviour, Outputs, at_most, equal, finite, poisons_of
from gsstream.testing.registry import check

WORLDS = ("one", "two identical", "coincident", "cloud", "logits of 20", "logits of 100", "huge logits")


def _spread(part: Propagation, case: World, logits: torch.Tensor | None = None) -> torch.Tensor:
    return part.propagate(case.logits if logits is None else logits, case.hierarchy)


def _owners(hierarchy: Hierarchy) -> torch.Tensor:
    """[M] bool: nodes with members."""
    used = torch.zeros(hierarchy.num_nodes, dtype=torch.bool)
    used[hierarchy.node_of] = True
    return used


@check("propagation")
def check_propagation_range(part: Propagation) -> None:
    """[M] finite logits, none above the largest that came in, also at +-1e4."""
    for name in WORLDS:
        case = get_case(name)
        got = _spread(part, case)
        m = case.hierarchy.num_nodes
        assert tuple(got.shape) == (m,), f"world {name!r}: expected shape [{m}], got {list(got.shape)}"
        finite(f"world {name!r}", got)
        why = f"{ROUNDING}; suspicion is spread, not invented"
        at_most(f"world {name!r}", got[_owners(case.hierarchy)], float(case.logits.max()), tolerance=1e-4, why=why)


@check("propagation", trait="normalised")
def check_propagation_normalised(part: Propagation) -> None:
    """A constant stays that constant at every node with members."""
    case = get_case("cloud")
    for constant in (-3.0, 0.0, 2.5):
        got = _spread(part, case, torch.full_like(case.logits, constant))[_owners(case.hierarchy)]
        equal(f"constant {constant}", got, torch.full_like(got, constant), tolerance=1e-5, why=ROUNDING)


@check("propagation", trait="normalised")
def check_propagation_flat_identity(part: Propagation) -> None:
    """On the flat structure nothing changes."""
    case = replace(get_case("cloud"), hierarchy=flat(len(get_case("cloud").logits)))
    equal("flat structure", _spread(part, case), case.logits, tolerance=1e-6, why=ROUNDING)


@check("propagation")
def check_propagation_relabelling(part: Propagation) -> None:
    """Renaming the nodes renames the result."""
    case = get_case("cloud")
    new = torch.randperm(case.hierarchy.num_nodes, generator=torch.Generator().manual_seed(4))
    old = torch.argsort(new)
    old_forest = case.hierarchy
    renamed = Hierarchy(new[old_forest.node_of], new[old_forest.parent[old]], old_forest.level[old])
    got = part.propagate(case.logits, renamed)
    equal("renamed nodes", got, _spread(part, case)[old], tolerance=1e-5, why=ROUNDING)


@check("propagation")
def check_propagation_monotone(part: Propagation) -> None:
    """Raising confidences lowers no node."""
    case = get_case("cloud")
    g = torch.Generator().manual_seed(8)
    for _ in range(4):
        some = torch.arange(len(case.logits)) % 5 == 0
        raised = _spread(part, case, case.logits + 4 * torch.rand(len(some), generator=g) * some)
        at_most("lower confidences against raised ones", _spread(part, case), raised, tolerance=1e-5, why=ROUNDING)


@check("propagation", trait="conservative")
def check_propagation_conservative(part: Propagation) -> None:
    """Nothing that changed is lost: a node's confidence is at least that of each of its members."""
    for name in WORLDS:
        case = get_case(name)
        held = _spread(part, case)[case.hierarchy.node_of]
        at_most(f"world {name!r}: members against their nodes", case.logits, held, tolerance=1e-5, why=ROUNDING)


@check("propagation")
def check_propagation_tree_local(part: Propagation) -> None:
    """Changing one tree leaves the others as they were, bit by bit."""
    case = get_case("cloud")
    root = tree_roots(case.hierarchy.parent)
    first = root[case.hierarchy.node_of[0]]
    changed = case.logits + 3.0 * (root[case.hierarchy.node_of] == first)
    before, after = _spread(part, case), _spread(part, case, changed)
    others = root != first
    equal("trees that did not change", after[others], before[others])


@check("propagation", trait="idempotent")
def check_propagation_idempotent(part: Propagation) -> None:
    """Giving the result back to the members and propagating again changes no node with members."""
    case = get_case("cloud")
    once = _spread(part, case)
    twice = _spread(part, case, once[case.hierarchy.node_of])
    owners = _owners(case.hierarchy)
    equal("second pass", twice[owners], once[owners], tolerance=1e-5, why=ROUNDING)


@check("propagation", trait="parent_bound")
def check_propagation_parent_bound(part: Propagation) -> None:
    """A parent's confidence is at least that of each of its children."""
    case = get_case("cloud")
    got = _spread(part, case)
    at_most("children against their parents", got, got[case.hierarchy.parent], tolerance=1e-5, why=ROUNDING)


@check("propagation", trait="differentiable")
def check_propagation_gradient(part: Propagation) -> None:
    """Agrees with finite differences in double precision away from ties; at ties the gradient is finite."""
    n = 24
    case = get_case("huge logits")
    distinct = torch.linspace(-4, 4, n, dtype=torch.float64)[torch.arange(n) * 7 % n].clone().requires_grad_(True)
    torch.autograd.gradcheck(lambda z: part.propagate(z, case.hierarchy), (distinct,), eps=1e-6, atol=1e-5)
    tied = torch.zeros(n, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(part.propagate(tied, case.hierarchy).sum(), tied)
    finite("gradient at ties", gradient)


def outputs(part: Propagation, world: World) -> Outputs:
    """Return logits per node."""
    return {"propagate()": part.propagate(world.logits, world.hierarchy)}


BEHAVIOUR = Behaviour(
    outputs, poisons_of("logits", usual=(12.0, -12.0)), shape=lambda world: (world.hierarchy.num_nodes,)
)
