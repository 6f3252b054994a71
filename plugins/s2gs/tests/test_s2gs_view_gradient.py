"""View-space gradient difference: formulas by hand, statistics, and motion found in rendered images."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from gsstream_s2gs.normalise import median
from gsstream_s2gs.view_gradient import ViewSpaceGradient
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from s2gs_scene import SIZE, moving, rig, told

FLOOR = -math.log(1000.0)


def estimator(**settings_: object) -> ViewSpaceGradient:
    return ViewSpaceGradient(ViewSpaceGradient.Config(**settings_))


def magnitudes(values: list[float]) -> torch.Tensor:
    """One view, gradients along x."""
    gradient = torch.zeros(1, len(values), 2)
    gradient[0, :, 0] = torch.tensor(values)
    return gradient


def auc(score: torch.Tensor, truth: torch.Tensor) -> float:
    """Probability that a moved Gaussian outranks a still one."""
    a, b = score[truth][:, None], score[~truth][None]
    return float(((a > b).double() + 0.5 * (a == b).double()).mean())


@pytest.mark.parametrize("units", ["ndc", "pixel"])
def test_rows_that_a_change_reaches_are_all_there_is_to_look_at(units: str) -> None:
    """The few rows that are asked for where that suffices: as the magnitudes of all rows have it, to the bit."""
    part, (seen, _) = estimator(units=units), moving()
    rows, few, _, _ = part._reached(seen)
    every, _, _ = part._magnitudes(seen)
    rest = torch.ones(len(every), dtype=torch.bool)
    rest[rows] = False
    assert len(rows)
    assert float(few.max()) > 0
    assert torch.equal(few, every[rows])
    assert not bool(every[rest].any())


class TestFormulas:
    values = (4.0, 1.0, 2.0, 10.0, 3.0)

    def test_robust_is_the_papers(self) -> None:
        z = estimator(units="pixel").estimate(told(magnitudes(list(self.values))))
        expected = (np.array(self.values) - 3.0) / (1.0 + 2e-4)  # median 3, MAD 1, no 1.4826
        np.testing.assert_allclose(z.numpy(), expected, rtol=1e-6)

    def test_ratio_is_the_logit_of_m_over_m_plus_median(self) -> None:
        z = estimator(units="pixel", normalisation="ratio").estimate(told(magnitudes(list(self.values))))
        p = np.array(self.values) / (np.array(self.values) + 3.0)
        np.testing.assert_allclose(torch.sigmoid(z).numpy(), p, rtol=1e-6)

    def test_minmax_is_the_logit_of_the_share_of_the_range(self) -> None:
        part = estimator(units="pixel", normalisation="minmax", statistics="seen")
        z = part.estimate(told(magnitudes(list(self.values))))
        p = (np.array(self.values) - 1) / 9
        np.testing.assert_allclose(torch.sigmoid(z.double()).numpy(), p, atol=1e-9)
        assert z.tolist()[1] == -50
        assert z.tolist()[3] == 50

    def test_units(self) -> None:
        pixel = estimator(units="pixel", epsilon=0).estimate(told(magnitudes(list(self.values))))
        half = estimator(units="ndc", epsilon=0).estimate(told(magnitudes(list(self.values))))
        torch.testing.assert_close(
            pixel, half
        )  # with one view and one axis the unit is a factor, and with epsilon 0 the factor cancels
        wide = dataclasses.replace(told(torch.ones(1, 3, 2)), cameras=dataclasses.replace(rig(1), width=200, height=50))
        assert estimator()._magnitudes(wide)[0].tolist() == pytest.approx([math.hypot(100, 25)] * 3)

    def test_aggregates(self) -> None:
        """The gradients of two views by one Gaussian are opposite; a third does not see it."""
        gradient = torch.tensor([[[3.0, 4.0]], [[-3.0, -4.0]], [[7.0, 7.0]]])
        visible = torch.tensor([[True], [True], [False]])
        context = told(gradient, visible)

        def of(how: str) -> float:
            return float(estimator(units="pixel", aggregate=how)._magnitudes(context)[0])

        assert of("mean-vector") == 0.0
        assert of("sum-of-norms") == 10.0
        assert of("mean-of-norms") == 5.0

    @given(st.lists(st.floats(0, 1e6), min_size=1, max_size=40))
    @settings(max_examples=100, deadline=None)
    def test_median_is_numpys(self, values: list[float]) -> None:
        assert float(median(torch.tensor(values, dtype=torch.float64))) == pytest.approx(float(np.median(values)))

    def test_mse_upstream_is_the_difference_of_two_gradients(self) -> None:
        """The closed form against autograd through the two losses of the paper."""
        context, _ = moving()
        for loss in ("mse", "l2norm"):
            render = context.previous_render(0).double().requires_grad_()
            now, before = context.image(0).double(), context.previous_image(0).double() + 0.01
            shifted = dataclasses.replace(context, before=[before] * 3, now=[now] * 3)
            if loss == "mse":
                errors = [(render - gt).square().mean() for gt in (now, before)]
            else:
                errors = [((render - gt).square().sum(-1) + 1e-12).sqrt().mean() for gt in (now, before)]
            (expected,) = torch.autograd.grad(errors[0] - errors[1], render)
            found = estimator(loss=loss)._upstream(shifted, 0)
            torch.testing.assert_close(found.double(), expected, rtol=1e-4, atol=1e-8)


class TestStatistics:
    def test_unseen_have_the_floor_and_do_not_enter_the_statistics(self) -> None:
        gradient = magnitudes([1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 0.0])
        visible = torch.tensor([[True] * 3 + [False] * 4])
        part = estimator(units="pixel", floor=-3.0)
        z = part.estimate(told(gradient, visible))
        torch.testing.assert_close(z[:3], part.estimate(told(gradient[:, :3])))
        assert z[3:].tolist() == [-3.0] * 4

    @pytest.mark.parametrize("normalisation", ["robust", "ratio"])
    def test_what_no_change_touches_does_not_enter_the_statistics(self, normalisation: str) -> None:
        """A mask leaves most of what is seen without a gradient: the touched must spread as if they were alone."""
        touched = magnitudes([1.0, 2.0, 3.0, 10.0])
        gradient = torch.cat([touched, torch.zeros(1, 60, 2)], 1)
        part = estimator(normalisation=normalisation, epsilon_mode="relative")
        z = part.estimate(told(gradient))
        torch.testing.assert_close(z[:4], part.estimate(told(touched)))
        assert z[4:].tolist() == [pytest.approx(FLOOR)] * 60
        assert float(z[:4].max() - z[:4].min()) > 1
        # Where Gaussians that no change touches are counted, too, as with "seen", the logits of all others saturate.
        alike = estimator(normalisation=normalisation, epsilon_mode="relative", statistics="seen")
        assert alike.estimate(told(gradient))[:4].tolist() == [50.0] * 4

    def test_gradient_of_an_invisible_gaussian_is_ignored(self) -> None:
        z = estimator().estimate(told(magnitudes([5.0, 1.0]), torch.tensor([[False, True]])))
        assert float(z[0]) == pytest.approx(FLOOR)

    def test_a_lone_outlier_among_equals(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """MAD = 0: the paper's epsilon alone divides; without it the deviation's sign decides."""
        with monkeypatch.context() as patch:
            patch.setattr("gsstream_s2gs.view_gradient.LIMIT", 1e4)
            z = estimator(units="pixel").estimate(told(magnitudes([1.0] * 9 + [1.1])))
        assert z[:9].tolist() == [0.0] * 9
        assert float(z[9]) == pytest.approx(0.1 / 2e-4, rel=1e-5)
        z = estimator(units="pixel", epsilon=0).estimate(told(magnitudes([1.0] * 9 + [1.1])))
        assert z.tolist() == [0.0] * 9 + [50.0]


class TestMotion:
    def test_noise_units_stay_calm_under_noise_and_wake_on_motion(self) -> None:
        """Camera noise alone keeps nearly everybody below p = 0.5; motion well above the noise does not."""
        context, moved = moving(shift=0.15)
        g, sigma = torch.Generator().manual_seed(0), 0.01
        noise = [sigma * torch.randn(SIZE, SIZE, 3, generator=g) for _ in range(3)]
        part = estimator(normalisation="noise", aggregate="mean-vector")
        quiet = dataclasses.replace(
            context, now=[b + n for b, n in zip(context.before, noise, strict=True)], sigma=sigma
        )
        assert float((part.estimate(quiet) > 0).float().mean()) < 0.1
        loud = dataclasses.replace(context, now=[a + n for a, n in zip(context.now, noise, strict=True)], sigma=sigma)
        z = part.estimate(loud)
        assert float((z[moved] > 0).float().mean()) > 0.6
        assert auc(z, moved) > 0.9


class TestPerturbation:
    def test_has_the_stated_strength_and_is_repeatable(self) -> None:
        values = torch.full((20_000,), 10.0, dtype=torch.float64)
        values[::2] = 12.0
        part = estimator(perturbation=0.5, seed=3)
        noisy = part._perturb(values, 1)
        assert torch.equal(noisy, part._perturb(values, 1))
        assert not torch.equal(noisy, part._perturb(values, 2))
        assert not torch.equal(noisy, estimator(perturbation=0.5, seed=4)._perturb(values, 1))
        error = (noisy - values).std()
        assert float(error) == pytest.approx(0.5, abs=4 * 0.5 / math.sqrt(2 * len(values)))

    def test_is_floored_at_zero(self) -> None:
        values = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).repeat(100)
        assert float(estimator(perturbation=2.0)._perturb(values, 1).min()) == 0.0


def test_contradictions_are_refused() -> None:
    with pytest.raises(ValidationError, match=r"expected loss mse .* got l2norm"):
        ViewSpaceGradient.Config(normalisation="noise", loss="l2norm")
    with pytest.raises(ValidationError, match="expected perturbation 0"):
        ViewSpaceGradient.Config(normalisation="noise", perturbation=0.1)
    with pytest.raises(ValidationError, match="normalization"):
        ViewSpaceGradient.Config(normalization="robust")
