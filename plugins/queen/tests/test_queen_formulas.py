"""Gates, latents, densification and change, against closed forms and independent walks."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from gsstream_queen.change import changed_tiles, gradient_difference
from gsstream_queen.densify import densify, densify_epochs
from gsstream_queen.gates import BOUND, gates, initial_logits, open_logit, open_probability
from gsstream_queen.latents import cosines, decoder, initial_weights, rounded, weight_of
from gsstream_queen.settings import (
    ChangeSettings,
    GateSettings,
    GrowthSettings,
    QueenConfig,
)
from gsstream_queen.trainable import OldRows
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from gsstream.api import Rng
from gsstream.blocks import DensifyStatistics, split_or_clone
from gsstream.testing import get_case
from gsstream.testing.cases import RENDERER, scene

GATE = GateSettings()
EVERYONE = torch.ones(5, dtype=torch.bool)


class TestGates:
    def test_a_gate_is_open_with_the_published_confidence(self) -> None:
        m = torch.tensor([0.0, 1.0, 2.0, 5.0, 20.0])
        p = open_probability(initial_logits(m, EVERYONE, GATE), GATE)
        expected = m / (m + 2.0)
        torch.testing.assert_close(p[1:], expected[1:])
        assert float(p[0]) < 2e-3, "what does not change is as closed as the bound allows"

    @given(st.floats(-BOUND, BOUND), st.floats(0.05, 3), st.floats(-3, -0.01), st.floats(1.001, 4))
    def test_more_likely_open_than_not_is_open(self, logit: float, t: float, gamma: float, eta: float) -> None:
        """Without noise the gate is above 0 exactly where its logit exceeds the shift, i.e. P(open) > 1/2."""
        settings, value = GateSettings(temperature=t), torch.tensor([logit], dtype=torch.float64)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("gsstream_queen.gates.GAMMA", gamma)
            patch.setattr("gsstream_queen.gates.ETA", eta)
            p, g = float(open_probability(value, settings)), float(gates(value, settings))
        assert 0 <= g <= 1
        if abs(p - 0.5) > 1e-9:
            assert (g > 0) == (p > 0.5)

    def test_ends_are_exact_and_flat(self) -> None:
        logits = torch.tensor([-3.0, 0.5, 3.0], requires_grad=True)
        value = gates(logits, GATE)
        assert value[0] == 0
        assert value[2] == 1
        assert 0 < value[1] < 1
        value.sum().backward()
        assert logits.grad is not None
        assert logits.grad[0] == logits.grad[2] == 0 < logits.grad[1]

    def test_the_law_of_noisy_gates(self) -> None:
        """P(gate > 0) of the hard concrete with logistic noise, counted: what L0 takes the closed form of."""
        generator = torch.Generator().manual_seed(0)
        u = torch.rand(200_000, generator=generator, dtype=torch.float64).clamp(1e-12, 1 - 1e-12)
        for logit in (-1.0, 0.0, 0.7):
            noisy = gates(torch.tensor(logit) + torch.log(u) - torch.log1p(-u), GATE)
            counted = float((noisy > 0).double().mean())
            assert abs(counted - float(open_probability(torch.tensor(logit), GATE))) < 4 * 0.5 / math.sqrt(len(u))

    def test_nothing_unseen_and_a_median_of_zero(self) -> None:
        assert bool((initial_logits(torch.zeros(5), EVERYONE, GATE) == -BOUND).all())
        m = torch.tensor([0.0, 0.0, 0.0, 1e-30, 9.0])
        assert initial_logits(m, EVERYONE, GATE).tolist() == pytest.approx([-BOUND] * 3 + [BOUND] * 2)
        hidden = torch.tensor([True, True, True, True, False])
        assert initial_logits(m, hidden, GATE)[4] == pytest.approx(-BOUND)
        for size in (1e-38, 3e37):
            assert bool(torch.isfinite(initial_logits(torch.arange(5.0) * size, EVERYONE, GATE)).all())


class TestLatents:
    @pytest.mark.parametrize("size", [1, 3, 8])
    def test_the_basis_is_the_cosine_transform(self, size: int) -> None:
        """Rows of the full square are orthogonal: it is a basis."""
        square = cosines(size, size)
        gram = square @ square.T
        torch.testing.assert_close(gram, torch.diag(gram.diagonal()), atol=1e-5, rtol=0)
        assert bool((square[0] == 1).all())

    def test_a_sent_decoder_gives_its_weights_back(self) -> None:
        for name, shape in (("scales", (3, 2)), ("opacities", (1, 1))):
            weight = torch.randn(shape, generator=torch.Generator().manual_seed(1))
            assert torch.equal(weight_of(name, decoder(name, weight, 3, 2)), weight)

    def test_rounding_is_real_and_its_gradient_straight(self) -> None:
        value = torch.tensor([0.4, 0.6, -1.5, 2.5, 7.0], requires_grad=True)
        out = rounded(value)
        assert out.tolist() == [0, 1, -2, 2, 7]
        out.sum().backward()
        assert value.grad is not None
        assert value.grad.tolist() == [1] * 5


class TestBirths:
    def test_epochs(self) -> None:
        published = GrowthSettings()
        assert sorted(densify_epochs(published, 10)) == [2, 4, 6, 8]
        assert sorted(densify_epochs(published, 6)) == [2, 4]
        assert densify_epochs(published, 1) == frozenset()
        assert densify_epochs(GrowthSettings(every=0), 10) == frozenset()
        assert densify_epochs(GrowthSettings(max_added=0), 10) == frozenset()

    def grow(self, room: int = 100, may: list[bool] | None = None):
        sizes = torch.tensor([0.001, 0.5, 0.001, 0.5])[:, None].expand(4, 3).log()
        rows = scene(torch.arange(12.0).reshape(4, 3), scales=sizes)
        grad_norm = torch.tensor([0.5, 0.9, 1e-9, 0.7])
        allowed = torch.tensor(may or [True] * 4)
        settings, generator = GrowthSettings(grad_threshold=0.1), torch.Generator().manual_seed(0)
        return rows, densify(rows, grad_norm, allowed, room, 1.0, settings, generator)

    def test_small_rows_are_cloned_and_large_ones_split(self) -> None:
        rows, litter = self.grow()
        assert litter.replaced.tolist() == [1, 3]
        assert len(litter.gaussians) == 5
        assert torch.equal(litter.gaussians.means[0], rows.means[0]), "a clone is where its parent is"
        halves = litter.gaussians.scales[1:].exp()
        torch.testing.assert_close(halves, torch.full_like(halves, 0.5 / 1.6))
        assert bool((litter.gaussians.means[1:] != rows.means[[1, 1, 3, 3]]).all())

    def test_the_largest_gradient_comes_first_when_there_is_little_room(self) -> None:
        for room, replaced, number in ((0, [], 0), (1, [], 0), (2, [1], 2), (3, [1], 2), (4, [1, 3], 4)):
            _, litter = self.grow(room)
            assert (litter.replaced.tolist(), len(litter.gaussians)) == (replaced, number), room

    def test_who_may_not_has_no_children(self) -> None:
        _, litter = self.grow(may=[True, False, True, False])
        assert (litter.replaced.tolist(), len(litter.gaussians)) == ([], 1)

    def test_halves_are_drawn_along_the_axes_of_their_parent(self) -> None:
        """An offset is the draw in units of the parent's size, turned by the parent's rotation matrix."""
        generator = torch.Generator().manual_seed(4)
        quats, sizes = torch.randn(9, 4, generator=generator), torch.rand(9, 3, generator=generator) + 0.1
        rows = replace(scene(torch.zeros(9, 3), scales=sizes.log()), quats=quats)
        halves, seeded = torch.ones(9, dtype=torch.bool), torch.Generator().manual_seed(7)
        added = split_or_clone(rows, torch.arange(9), halves, seeded).means
        draws = torch.randn(9, 3, generator=torch.Generator().manual_seed(7)) * sizes
        for q, v, got in zip(quats, draws, added, strict=True):
            w, x, y, z = (q / q.norm()).tolist()
            matrix = torch.tensor(
                [
                    [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                    [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                    [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
                ]
            )
            torch.testing.assert_close(got, matrix @ v, atol=1e-5, rtol=1e-5)

    def test_means_count_only_the_iterations_that_hit(self) -> None:
        none = DensifyStatistics.zeros(2, torch.device("cpu"))
        statistics = none.add(torch.tensor([[3.0, 4.0], [0, 0]])).add(torch.zeros(2, 2))
        assert statistics.mean.tolist() == [5.0, 0.0]


class TestChange:
    @pytest.mark.parametrize("loss", ["mse", "l2norm"])
    @pytest.mark.parametrize("aggregate", ["mean-vector", "sum-of-norms"])
    def test_it_is_the_gradient_of_the_difference_of_two_distances(self, loss: str, aggregate: str) -> None:
        case = get_case("moving")
        found = gradient_difference(case, ChangeSettings(loss=loss, aggregate=aggregate))  # type: ignore[arg-type]
        gradients = []
        for view in range(len(case.cameras)):
            shown = case.previous_render(view).requires_grad_()

            def distance(truth: torch.Tensor, shown: torch.Tensor = shown) -> torch.Tensor:
                squared = (shown - truth).square()
                return squared.mean() if loss == "mse" else squared.sum(-1).add(1e-12).sqrt().mean()

            (upstream,) = torch.autograd.grad(distance(case.now[view]) - distance(case.before[view]), shown)
            half = torch.tensor([case.cameras.width / 2, case.cameras.height / 2])
            gradients.append(case.screen_gradient(view, upstream).gradient * half)
        every = torch.stack(gradients)
        expected = every.mean(0).norm(dim=1) if aggregate == "mean-vector" else every.norm(dim=2).sum(0)
        torch.testing.assert_close(found.difference, expected, atol=1e-6, rtol=1e-4)
        moved = found.difference[case.moving_mask].mean()
        assert moved > 3 * found.difference[~case.moving_mask].mean(), "what moved feels more than what did not"

    def test_still_images_change_nothing(self) -> None:
        assert float(gradient_difference(get_case("moving").blended(0), ChangeSettings()).difference.max()) == 0  # type: ignore[arg-type]

    def test_tiles_follow_the_dynamic_rows(self, monkeypatch: pytest.MonkeyPatch) -> None:
        case = get_case("moving")
        everyone = torch.ones(len(case.gaussians), dtype=torch.bool)
        monkeypatch.setattr("gsstream_queen.change.PIXELS", 1)
        monkeypatch.setattr("gsstream_queen.change.DILATE", 0)
        masks = changed_tiles(case, everyone, RENDERER)  # type: ignore[arg-type]
        assert len(masks) == len(case.cameras)
        for view, mask in enumerate(masks):
            alpha = RENDERER.render(case.gaussians, case.cameras, view, (0.0, 0.0, 0.0)).alpha.detach().numpy() > 0.5
            for row, column in np.ndindex(*mask.shape):
                tile = alpha[row * 16 : row * 16 + 16, column * 16 : column * 16 + 16]
                assert bool(mask[row, column]) == (tile.sum() >= tile.size / 256), (view, row, column)
        monkeypatch.setattr("gsstream_queen.change.DILATE", 2)
        wide = changed_tiles(case, everyone, RENDERER)  # type: ignore[arg-type]
        assert all(bool(mask.all()) for mask, small in zip(wide, masks, strict=True) if small.any())
        none = changed_tiles(case, ~everyone, RENDERER)  # type: ignore[arg-type]
        assert not any(bool(mask.any()) for mask in none)


def test_settings_that_contradict_themselves() -> None:
    with pytest.raises(ValidationError, match=r"expected start <= stop, got 0\.9 and 0\.8"):
        QueenConfig(growth=GrowthSettings(start=0.9))
    assert set(QueenConfig().latents()) == {"quats", "scales", "opacities", "sh0", "shN"}
    policies = QueenConfig()
    frozen = policies.model_copy(
        update={
            "sh0": policies.sh0.model_copy(update={"policy": "frozen"}),
            "quats": policies.quats.model_copy(update={"lr": 0.0}),
        }
    )
    assert set(frozen.latents()) == {"scales", "opacities", "shN"}


def old_rows(number: int, **settings: object) -> OldRows:
    config = QueenConfig(**settings)
    base = scene(torch.zeros(number, 3))
    weights = initial_weights(config.latents(), base, Rng(0))
    return OldRows(config, base, torch.zeros(number), weights, 1.0, number, 100)


def test_l0_is_a_sum_or_a_mean() -> None:
    probability = float(torch.sigmoid(torch.tensor(-open_logit(GateSettings()))))
    for over, factor in (("sum", 7.0), ("mean", 1.0)):
        rows = old_rows(7, gate=GateSettings(l0=0.25, l0_over=over))
        assert float(rows._penalty().detach()) == pytest.approx(0.25 * factor * probability, rel=1e-6)


def test_sigma_weighs_the_spread_of_the_latents() -> None:
    rows = old_rows(6, gate=GateSettings(l0=0), sigma=2.0)
    generator, spreads = torch.Generator().manual_seed(0), []
    for value in rows._latents.values():
        value.data = torch.randn(value.shape, generator=generator)
        spreads += value.detach().std(0).tolist()
    assert float(rows._penalty().detach()) == pytest.approx(2 * sum(spreads) / len(spreads), rel=1e-5)


def test_rate_moves_latents_towards_zero_and_nothing_else_does() -> None:
    for rate in (0.0, 1.0):
        rows = old_rows(5, gate=GateSettings(l0=0), rate=rate)
        for value in rows._latents.values():
            value.data += 3.0
        rows.step()
        moved = [bool((value < 3.0).all()) for value in rows._latents.values()]
        assert moved == [rate > 0] * len(moved)
