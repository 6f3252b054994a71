"""Gates, maxima over trees, selective leaf-level gating and expected sparsity: the paper's formulas by hand."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from gsstream_s2gs.expected_sparsity import ExpectedSparsity
from gsstream_s2gs.gumbel_sigmoid import GumbelSigmoid
from gsstream_s2gs.hierarchical import HierarchicalMax
from gsstream_s2gs.selective_leaf import SelectiveLeaf
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from gsstream.api import Hierarchy, Propagation, ShapeError


def forest(parents: list[int], node_of: list[int]) -> Hierarchy:
    """A forest from parents (a root is its own)."""
    depth = []
    for node in range(len(parents)):
        steps = 0
        while parents[node] != node:
            node, steps = parents[node], steps + 1
        depth.append(steps)
    return Hierarchy(torch.tensor(node_of, dtype=torch.int64), torch.tensor(parents), torch.tensor(depth))


def walked(logits: list[float], hierarchy: Hierarchy, suspect: float, spread: float, empty: float) -> list[float]:
    """The definition, node by node, in plain Python; with a ``spread`` of 0 every tree moves as one."""
    parents, node_of = hierarchy.parent.tolist(), hierarchy.node_of.tolist()

    def above(node: int) -> list[int]:
        chain = [node]
        while parents[chain[-1]] != chain[-1]:
            chain.append(parents[chain[-1]])
        return chain

    def subtree(node: int) -> float:
        inside = [z for z, n in zip(logits, node_of, strict=True) if node in above(n)]
        over = parents[node]
        return max(inside) if inside else empty if over == node else min(empty, subtree(over))

    out = []
    for node in range(len(parents)):
        root = above(node)[-1]
        owners = {n for n in node_of if above(n)[-1] == root}
        loud = {n for n in owners if max(z for z, m in zip(logits, node_of, strict=True) if m == n) > suspect}
        out.append(subtree(root if len(loud) >= spread * len(owners) else node))
    return out


@settings(max_examples=150, deadline=None)
@given(
    data=st.data(), nodes=st.integers(1, 9), count=st.integers(0, 20), suspect=st.sampled_from([-1.5, 0.0, 1.0]),
    spread=st.sampled_from([0.0, 0.01, 0.25, 0.5, 1.0]),
)  # fmt: skip
def test_against_a_plain_walk(data: st.DataObject, nodes: int, count: int, suspect: float, spread: float) -> None:
    """Forests of any shape, nodes in any order, members on any node; ``spread`` 0 stands for the maximum of trees."""
    parents = [data.draw(st.integers(0, node)) for node in range(nodes)]
    names = data.draw(st.permutations(range(nodes)))
    renamed = [0] * nodes
    for node, parent in enumerate(parents):
        renamed[names[node]] = names[parent]
    node_of = data.draw(st.lists(st.integers(0, nodes - 1), min_size=count, max_size=count))
    values = st.integers(-4, 4).map(float) | st.floats(-1e4, 1e4, width=32)
    logits = data.draw(st.lists(values, min_size=count, max_size=count))
    hierarchy, part = forest(renamed, node_of), HierarchicalMax()
    if spread > 0:
        part = SelectiveLeaf(SelectiveLeaf.Config(suspect=suspect, spread=spread))
    got = part.propagate(torch.tensor(logits), hierarchy)
    assert got.tolist() == walked(logits, hierarchy, suspect, spread, -50.0)


def test_a_still_leaf_beside_a_moving_one_stays_closed() -> None:
    """Two regions of four leaves: in the first one leaf moves, in the second three do."""
    hierarchy = forest([0, 1, 0, 0, 0, 0, 1, 1, 1, 1], [2, 3, 4, 5, 6, 7, 8, 9])
    z = torch.tensor([5.0, -3.0, -3.0, -3.0, 4.0, 4.0, 4.0, -3.0])
    got = SelectiveLeaf().propagate(z, hierarchy)
    assert got.tolist() == [5.0, 4.0, 5.0, -3.0, -3.0, -3.0, 4.0, 4.0, 4.0, 4.0]
    assert HierarchicalMax().propagate(z, hierarchy).tolist() == [5.0, 4.0, 5.0, 5.0, 5.0, 5.0, 4.0, 4.0, 4.0, 4.0]


def test_the_gradient_goes_to_the_maximum_and_ties_share_it() -> None:
    z = torch.tensor([1.0, 3.0, 2.0, 2.0], requires_grad=True)
    HierarchicalMax().propagate(z, forest([0, 1], [0, 0, 1, 1])).sum().backward()
    assert z.grad is not None
    assert z.grad.tolist() == [0.0, 1.0, 0.5, 0.5]


def example(n: int = 12, nodes: int = 4, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, Hierarchy]:
    g = torch.Generator().manual_seed(seed)
    hierarchy = forest(list(range(nodes)), torch.randint(nodes, (n,), generator=g).tolist())
    probability = torch.rand(nodes, generator=g, dtype=torch.float64)
    return probability, torch.randn(n, 3, generator=g, dtype=torch.float64), hierarchy


def sparsity(rows: int | None = None, **settings_: object) -> dict[str, float]:
    """Terms of the example, of ``rows`` Gaussians."""
    p, o, h = example()
    part = ExpectedSparsity(ExpectedSparsity.Config(**settings_))
    return {name: float(value) for name, value in part.penalty(p, o, h, rows or len(o)).items()}


def test_the_papers_formula_and_the_released_one() -> None:
    p, o, h = example()
    nodes = h.node_of.tolist()
    gates = 0.01 * sum(float(p[j]) for j in nodes)
    motion = 0.02 * sum(float(p[j]) * float(o[i] @ o[i]) for i, j in enumerate(nodes))
    assert sparsity(lambda2=0.02, reduction="sum") == pytest.approx({"sparsity": gates, "motion": motion}, rel=1e-12)
    assert sparsity(48, lambda2=0.02) == pytest.approx({"sparsity": gates / 48, "motion": motion / 48}, rel=1e-12)
    released = np.mean([float(p[j]) * 0.5 * 0.01 * float(o[i].square().mean()) for i, j in enumerate(nodes)])
    assert sparsity(motion="half-mean")["motion"] == pytest.approx(released, rel=1e-12)


def circle(length: int) -> Hierarchy:
    return Hierarchy(torch.tensor([0]), torch.arange(length).roll(1), torch.zeros(length, dtype=torch.int64))


OPENED, MOVED, NODES = example()
FLAT = forest([0, 1, 2], [0, 1, 2])
REFUSED: dict[str, Callable[[], object]] = {
    r"residual: expected shape \[12, 3\]": lambda: ExpectedSparsity().penalty(OPENED, MOVED[:5], NODES, 12),
    r"open_probability: expected shape \[4\]": lambda: ExpectedSparsity().penalty(OPENED[:3], MOVED, NODES, 12),
    "expected at least the 12 active rows, got 11": lambda: ExpectedSparsity().penalty(OPENED, MOVED, NODES, 11),
    r"logits: expected shape \[3\], got \[2\]": lambda: HierarchicalMax().propagate(torch.zeros(2), FLAT),
    "level: expected one more": lambda: SelectiveLeaf().propagate(
        torch.tensor([3.0]), Hierarchy(torch.tensor([1]), torch.tensor([0, 0]), torch.tensor([0, 0]))
    ),
}


@pytest.mark.parametrize("message", REFUSED)
def test_refusals(message: str) -> None:
    with pytest.raises(ShapeError, match=message):
        REFUSED[message]()


@pytest.mark.parametrize("part", [HierarchicalMax(), SelectiveLeaf()], ids=repr)
@pytest.mark.parametrize("length", [2, 3, 5, 8])
def test_circles_are_refused(part: Propagation, length: int) -> None:
    with pytest.raises(ShapeError, match=f"cycle among {length} nodes"):
        part.propagate(torch.tensor([0.0]), circle(length))


def test_a_price_below_zero_is_refused() -> None:
    with pytest.raises(ValidationError, match="lambda1"):
        ExpectedSparsity.Config(lambda1=-1)


def sampler(**settings_: object) -> GumbelSigmoid:
    return GumbelSigmoid(GumbelSigmoid.Config(**settings_))


def test_the_papers_map_from_confidence_to_gate() -> None:
    """Temperature 0.3, one decimal: what each confidence becomes."""
    p = torch.tensor([0.29, 0.30, 0.40, 0.50, 0.60, 0.70, 0.72], dtype=torch.float64)
    gates = sampler().sample(torch.logit(p), None)
    assert [round(float(g), 1) for g in gates] == [0.0, 0.1, 0.2, 0.5, 0.8, 0.9, 1.0]


def test_the_edge_of_the_dead_zone_and_the_papers_threshold() -> None:
    edge = 0.3 * math.log(0.05 / 0.95)
    assert edge == pytest.approx(-0.8833, abs=1e-4)
    gates = sampler().sample(torch.tensor([edge - 1e-4, edge + 1e-4]), None)
    assert gates.tolist() == [0.0, pytest.approx(0.1)]
    alpha = torch.tensor([-2.0, 0.0, 1.5], dtype=torch.float64)
    torch.testing.assert_close(sampler().open_probability(alpha), torch.sigmoid(alpha - edge))


def test_one_gumbel_draw_has_the_law_of_the_released_initialisation() -> None:
    """P(z + n > threshold) = 1 - exp(-exp(z - threshold)) for one draw, whose mean is Euler's constant."""
    n, gate = 200_000, sampler(noise="gumbel")
    drawn = gate.noise(n, torch.Generator().manual_seed(0))
    assert drawn is not None
    assert float(drawn.double().mean()) == pytest.approx(0.5772, abs=4 * math.pi / math.sqrt(6 * n))
    margin = torch.tensor([-3.0, 0.0, 2.0], dtype=torch.float64)
    found = gate.open_probability(margin + 0.3 * math.log(0.05 / 0.95))
    torch.testing.assert_close(found, 1 - torch.exp(-torch.exp(margin)))


def test_nothing_flows_into_the_noise() -> None:
    gate, logits = sampler(), torch.linspace(-3, 3, 40)
    noise = gate.noise(40, torch.Generator().manual_seed(5))
    assert noise is not None
    assert not gate.sample(logits, noise.requires_grad_()).requires_grad


def test_released_clamp_kills_the_gradient_at_the_ends() -> None:
    logits = torch.tensor([-2.0, 0.0, 2.0], requires_grad=True)
    gate = sampler(clamp_gradient=True)
    (gradient,) = torch.autograd.grad(gate.sample(logits, None).sum(), logits)
    assert gradient[0] == gradient[2] == 0
    assert gradient[1] > 0
    assert torch.equal(gate.sample(logits, None), sampler().sample(logits, None))
    binary = torch.linspace(-3, 3, 30).requires_grad_()
    (dead,) = torch.autograd.grad(sampler(levels=1, clamp_gradient=True).sample(binary, None).sum(), binary)
    assert not dead.any()  # the collapse of binary gates in the released code


@pytest.mark.parametrize(
    "bad", [{"temperature": 0.0}, {"levels": 0}, {"levels": 256}, {"noise": "normal"}, {"logit_bound": 0.0}, {"tau": 1}]
)
def test_impossible_settings_are_refused(bad: dict[str, object]) -> None:
    with pytest.raises(ValidationError, match=next(iter(bad))):
        GumbelSigmoid.Config(**bad)
