"""Hierarchical maximum and expected sparsity."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from gsstream_s2gs.expected_sparsity import ExpectedSparsity
from gsstream_s2gs.hierarchical import HierarchicalMax
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from gsstream.api import Hierarchy, ShapeError, tree_roots


@st.composite
def forests(draw: st.DrawFn, members: int = 20) -> Hierarchy:
    """Random forests of any shape, with nodes in any order and members on any node."""
    m = draw(st.integers(1, 9))
    parent = [draw(st.integers(0, i)) for i in range(m)]  # a node whose parent is itself is a root
    level = [0] * m
    for i in range(m):
        level[i] = 0 if parent[i] == i else level[parent[i]] + 1
    names = draw(st.permutations(range(m)))
    node_of = draw(st.lists(st.integers(0, m - 1), min_size=0, max_size=members))
    renamed_parent, renamed_level = [0] * m, [0] * m
    for i in range(m):
        renamed_parent[names[i]] = names[parent[i]]
        renamed_level[names[i]] = level[i]
    hierarchy = Hierarchy(
        torch.tensor([names[j] for j in node_of], dtype=torch.int64),
        torch.tensor(renamed_parent),
        torch.tensor(renamed_level),
    )
    hierarchy.validate()
    return hierarchy


def logits_for(data: st.DataObject, hierarchy: Hierarchy) -> torch.Tensor:
    n = hierarchy.num_gaussians
    return torch.tensor(data.draw(st.lists(st.floats(-1e4, 1e4, width=32), min_size=n, max_size=n)))


def flat(n: int) -> Hierarchy:
    index = torch.arange(n)
    return Hierarchy(index, index, torch.zeros_like(index))


class TestHierarchicalMax:
    part = HierarchicalMax()

    @given(st.data())
    @settings(max_examples=150, deadline=None)
    def test_against_a_plain_walk(self, data: st.DataObject) -> None:
        hierarchy = data.draw(forests())
        z = logits_for(data, hierarchy)
        best: dict[int, float] = {}

        def root(node: int) -> int:
            while int(hierarchy.parent[node]) != node:
                node = int(hierarchy.parent[node])
            return node

        for i, node in enumerate(hierarchy.node_of.tolist()):
            best[root(node)] = max(best.get(root(node), -math.inf), float(z[i]))
        expected = [best.get(root(node), -50.0) for node in range(hierarchy.num_nodes)]
        found = self.part.propagate(z, hierarchy)
        assert found.tolist() == expected
        spread = found[hierarchy.node_of]
        assert bool((spread >= z).all())  # conservative
        assert torch.equal(self.part.propagate(spread, hierarchy), found)  # idempotent

    @given(st.data())
    @settings(max_examples=60, deadline=None)
    def test_monotone_and_tree_local(self, data: st.DataObject) -> None:
        hierarchy = data.draw(forests())
        z = logits_for(data, hierarchy)
        if len(z) == 0:
            return
        raised = z.clone()
        raised[data.draw(st.integers(0, len(z) - 1))] += 5.0
        before, after = self.part.propagate(z, hierarchy), self.part.propagate(raised, hierarchy)
        assert bool((after >= before).all())
        home = tree_roots(hierarchy.parent)
        tree = home[hierarchy.node_of[(raised != z).nonzero()[0, 0]]]
        assert torch.equal(before[home != tree], after[home != tree])

    @given(st.data())
    @settings(max_examples=40, deadline=None)
    def test_order_of_gaussians_does_not_matter(self, data: st.DataObject) -> None:
        hierarchy = data.draw(forests())
        z = logits_for(data, hierarchy)
        order = torch.tensor(data.draw(st.permutations(range(len(z)))), dtype=torch.int64)
        assert torch.equal(self.part.propagate(z[order], hierarchy.rows(order)), self.part.propagate(z, hierarchy))

    def test_one_level_is_the_group_maximum_of_the_paper(self) -> None:
        index = torch.arange(3)
        hierarchy = Hierarchy(torch.tensor([0, 0, 2, 2, 2]), index, torch.zeros_like(index))
        z = torch.tensor([-1.0, -3.0, 0.0, 4.0, 2.0])
        assert self.part.propagate(z, hierarchy).tolist() == [-1.0, -50.0, 4.0]

    def test_the_sigmoid_commutes(self) -> None:
        z = torch.randn(30, generator=torch.Generator().manual_seed(0))
        index = torch.arange(4)
        hierarchy = Hierarchy(torch.arange(30) % 4, index, torch.zeros_like(index))
        found = torch.sigmoid(self.part.propagate(z, hierarchy))
        assert torch.equal(found, self.part.propagate(torch.sigmoid(z), hierarchy))

    def test_flat_is_the_identity(self) -> None:
        z = torch.tensor([-100.0, 0.0, 3.0])
        assert torch.equal(self.part.propagate(z, flat(3)), z)

    def test_a_long_chain(self) -> None:
        n = 5000
        parent = torch.clamp(torch.arange(n) - 1, min=0)
        hierarchy = Hierarchy(torch.tensor([n - 1, 3]), parent, torch.arange(n))
        assert self.part.propagate(torch.tensor([2.0, 1.0]), hierarchy).unique().tolist() == [2.0]

    def test_gradient_goes_to_the_maximum(self) -> None:
        z = torch.tensor([1.0, 3.0, 2.0, 2.0], requires_grad=True)
        index = torch.arange(2)
        hierarchy = Hierarchy(torch.tensor([0, 0, 1, 1]), index, torch.zeros_like(index))
        self.part.propagate(z, hierarchy).sum().backward()
        assert z.grad is not None
        assert z.grad.tolist() == [0.0, 1.0, 0.5, 0.5]

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    def test_dtype_and_empty(self, dtype: torch.dtype) -> None:
        assert self.part.propagate(torch.zeros(0, dtype=dtype), flat(0)).dtype == dtype
        lonely = Hierarchy(torch.zeros(0, dtype=torch.int64), torch.tensor([0]), torch.tensor([0]))
        assert self.part.propagate(torch.zeros(0, dtype=dtype), lonely).tolist() == [-50.0]

    def test_refusals(self) -> None:
        with pytest.raises(ShapeError, match=r"logits: expected shape \[3\], got \[2\]"):
            self.part.propagate(torch.zeros(2), flat(3))
        with pytest.raises(ShapeError, match=r"logits: expected finite values, got nan at index \[1\]"):
            self.part.propagate(torch.tensor([0.0, math.nan, 0.0]), flat(3))
        for length in (2, 3, 4, 5, 8):
            circle = Hierarchy(torch.tensor([0]), torch.arange(length).roll(1), torch.zeros(length, dtype=torch.int64))
            with pytest.raises(ShapeError, match=f"cycle among {length} nodes"):
                self.part.propagate(torch.tensor([0.0]), circle)


def sparsity(**settings_: object) -> ExpectedSparsity:
    return ExpectedSparsity(ExpectedSparsity.Config(**settings_))


def example(n: int = 12, nodes: int = 4, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, Hierarchy]:
    g = torch.Generator().manual_seed(seed)
    index = torch.arange(nodes)
    hierarchy = Hierarchy(torch.randint(nodes, (n,), generator=g), index, torch.zeros_like(index))
    probability = torch.rand(nodes, generator=g, dtype=torch.float64)
    return probability, torch.randn(n, 3, generator=g, dtype=torch.float64), hierarchy


def total(part: ExpectedSparsity, p: torch.Tensor, o: torch.Tensor, h: Hierarchy, n: int) -> torch.Tensor:
    terms = part.penalty(p, o, h, n)
    assert list(terms) == ["sparsity", "motion"]
    assert all(t.shape == () and t.dtype == p.dtype for t in terms.values())
    return terms["sparsity"] + terms["motion"]


class TestExpectedSparsity:
    def test_the_papers_formula(self) -> None:
        p, o, h = example()
        expected = sum(float(p[j]) * (0.01 + 0.02 * float(o[i] @ o[i])) for i, j in enumerate(h.node_of.tolist()))
        part = sparsity(lambda2=0.02, reduction="sum")
        assert float(total(part, p, o, h, 12)) == pytest.approx(expected, rel=1e-12)
        assert float(total(sparsity(lambda2=0.02), p, o, h, 48)) == pytest.approx(expected / 48, rel=1e-12)

    def test_the_released_formula(self) -> None:
        p, o, h = example()
        expected = np.mean([float(p[j]) * 0.5 * 0.01 * float(o[i].square().mean()) for i, j in enumerate(h.node_of)])
        found = sparsity(motion="half-mean").penalty(p, o, h, 12)["motion"]
        assert float(found) == pytest.approx(expected, rel=1e-12)
        assert float(found) * 6 == pytest.approx(float(sparsity().penalty(p, o, h, 12)["motion"]))

    def test_zero_at_rest(self) -> None:
        p, o, h = example()
        assert float(total(sparsity(), torch.zeros_like(p), torch.zeros_like(o), h, 12)) == 0.0
        assert float(sparsity().penalty(p, torch.zeros_like(o), h, 12)["motion"]) == 0.0
        assert float(total(sparsity(), torch.zeros_like(p), o, h, 12)) == 0.0

    @pytest.mark.parametrize("reduction", ["mean", "sum"])
    def test_linear_in_the_weights(self, reduction: str) -> None:
        p, o, h = example()
        one = sparsity(reduction=reduction).penalty(p, o, h, 12)
        two = sparsity(reduction=reduction, lambda1=0.02, lambda2=0.03).penalty(p, o, h, 12)
        assert float(two["sparsity"]) == pytest.approx(2 * float(one["sparsity"]))
        assert float(two["motion"]) == pytest.approx(3 * float(one["motion"]))
        none = sparsity(lambda1=0, lambda2=0)
        p.requires_grad_()
        o.requires_grad_()
        value = total(none, p, o, h, 12)
        assert value.item() == 0.0
        assert not any(g.any() for g in torch.autograd.grad(value, (p, o)))

    def test_gradient(self) -> None:
        p, o, h = example()
        o[3] = 0.0
        inputs = (p.requires_grad_(), o.requires_grad_())
        assert torch.autograd.gradcheck(lambda a, b: total(sparsity(), a, b, h, 20), inputs)
        zero = torch.zeros_like(o, requires_grad=True)
        for motion in ("squared-norm", "half-mean"):
            (gradient,) = torch.autograd.grad(total(sparsity(motion=motion), p, zero, h, 20), zero)
            assert not gradient.any()  # finite, and exactly 0

    def test_terms_use_what_they_say(self) -> None:
        p, o, h = example()
        o.requires_grad_()
        terms = sparsity().penalty(p, o, h, 12)
        assert not terms["sparsity"].requires_grad
        assert terms["motion"].requires_grad

    @given(st.integers(0, 11), st.floats(0.01, 3.0), st.booleans())
    @settings(max_examples=40, deadline=None)
    def test_monotone(self, row: int, more: float, gate: bool) -> None:
        p, o, h = example()
        p = p * 0.5
        q, r = p.clone(), o.clone()
        if gate:
            q[row % 4] += 0.5 * min(more, 1.0)
        else:
            r[row] = r[row] + torch.sign(r[row]) * more
        assert float(total(sparsity(), q, r, h, 12)) >= float(total(sparsity(), p, o, h, 12))

    def test_order_and_doubling(self) -> None:
        p, o, h = example()
        order = torch.randperm(12, generator=torch.Generator().manual_seed(4))
        value = total(sparsity(), p, o, h, 12)
        torch.testing.assert_close(total(sparsity(), p, o[order], h.rows(order), 12), value)
        twice = torch.cat([torch.arange(12), torch.arange(12)])
        torch.testing.assert_close(total(sparsity(), p, o[twice], h.rows(twice), 24), value)
        summed = sparsity(reduction="sum")
        torch.testing.assert_close(total(summed, p, o[twice], h.rows(twice), 24), 2 * total(summed, p, o, h, 12))

    def test_rows_left_out_are_rows_at_rest(self) -> None:
        p, o, h = example()
        open_ = h.node_of != 0
        p[0] = 0.0
        whole = total(sparsity(), p, o, h, 12)
        torch.testing.assert_close(total(sparsity(), p, o[open_], h.rows(open_), 12), whole)

    def test_ten_million_rows_lose_no_digits(self) -> None:
        """Added one by one in float32, 0.1 stops growing long before 1e7 terms."""
        n = 10_000_000
        node = torch.zeros(1, dtype=torch.int64)
        hierarchy = Hierarchy(torch.zeros(n, dtype=torch.int64), node, node)
        p = torch.tensor([0.1], requires_grad=True)
        value = sparsity(lambda2=0.0).penalty(p, torch.zeros(1, 3).expand(n, 3), hierarchy, n)
        (gradient,) = torch.autograd.grad(sum(value.values()), p)
        assert value["sparsity"].item() == pytest.approx(1e-3, rel=1e-6)
        assert float(gradient) == pytest.approx(0.01, rel=1e-6)
        n = 2_000_000
        part = Hierarchy(hierarchy.node_of[:n], node, node)
        motion = sparsity().penalty(p.detach(), torch.full((1, 3), 0.1).expand(n, 3), part, n)["motion"]
        assert float(motion) == pytest.approx(0.1 * 0.01 * 0.03, rel=1e-6)

    @pytest.mark.parametrize("n", [0, 1, 100])
    def test_nobody_active(self, n: int) -> None:
        empty = Hierarchy(torch.zeros(0, dtype=torch.int64), torch.tensor([0]), torch.tensor([0]))
        assert float(total(sparsity(), torch.ones(1), torch.zeros(0, 3), empty, n)) == 0.0

    def test_refusals(self) -> None:
        p, o, h = example()
        with pytest.raises(ShapeError, match=r"residual: expected shape \[12, 3\]"):
            sparsity().penalty(p, o[:5], h, 12)
        with pytest.raises(ShapeError, match=r"open_probability: expected shape \[4\]"):
            sparsity().penalty(p[:3], o, h, 12)
        with pytest.raises(ShapeError, match="expected at least the 12 active rows, got 11"):
            sparsity().penalty(p, o, h, 11)
        with pytest.raises(ValidationError, match="lambda1"):
            ExpectedSparsity.Config(lambda1=-1)
