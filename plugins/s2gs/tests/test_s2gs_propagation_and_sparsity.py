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
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from gsstream.api import Hierarchy, ShapeError


def forest(parents: list[int], node_of: list[int]) -> Hierarchy:
    """A forest from parents (a root is its own)."""
    depth = []
    for node in range(len(parents)):
        steps = 0
        while parents[node] != node:
            node, steps = parents[node], steps + 1
        depth.append(steps)
    return Hierarchy(torch.tensor(node_of, dtype=torch.int64), torch.tensor(parents), torch.tensor(depth))


def walked(logits: list[float], hierarchy: Hierarchy, empty: float) -> list[float]:
    """The definition, node by node, in plain Python: the maximum over the tree, or ``empty`` without members."""
    parents, node_of = hierarchy.parent.tolist(), hierarchy.node_of.tolist()

    def root(node: int) -> int:
        while parents[node] != node:
            node = parents[node]
        return node

    members = list(zip(logits, node_of, strict=True))
    inside = [[z for z, n in members if root(n) == root(node)] for node in range(len(parents))]
    return [max(values) if values else empty for values in inside]


@settings(max_examples=150, deadline=None)
@given(data=st.data(), nodes=st.integers(1, 9), count=st.integers(0, 20))
def test_against_a_plain_walk(data: st.DataObject, nodes: int, count: int) -> None:
    """Forests of any shape, nodes in any order, members on any node."""
    parents = [data.draw(st.integers(0, node)) for node in range(nodes)]
    names = data.draw(st.permutations(range(nodes)))
    renamed = [0] * nodes
    for node, parent in enumerate(parents):
        renamed[names[node]] = names[parent]
    node_of = data.draw(st.lists(st.integers(0, nodes - 1), min_size=count, max_size=count))
    values = st.integers(-4, 4).map(float) | st.floats(-1e4, 1e4, width=32)
    logits = data.draw(st.lists(values, min_size=count, max_size=count))
    hierarchy = forest(renamed, node_of)
    got = HierarchicalMax().propagate(torch.tensor(logits), hierarchy)
    assert got.tolist() == walked(logits, hierarchy, -50.0)


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
}


@pytest.mark.parametrize("message", REFUSED)
def test_refusals(message: str) -> None:
    with pytest.raises(ShapeError, match=message):
        REFUSED[message]()


@pytest.mark.parametrize("length", [2, 3, 5, 8])
def test_circles_are_refused(length: int) -> None:
    with pytest.raises(ShapeError, match=f"cycle among {length} nodes"):
        HierarchicalMax().propagate(torch.tensor([0.0]), circle(length))


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
