"""Confidence in units of noise, and confidence for what was never right."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from gsstream_s2gs.error_aware import ErrorAware
from gsstream_s2gs.gumbel_sigmoid import GumbelSigmoid
from gsstream_s2gs.noise_normalised import NoiseNormalised
from gsstream_s2gs.noise_ratios import noise_ratios
from gsstream_s2gs.uniform_random import UniformRandom
from s2gs_scene import SIZE, context, gaussians, images, moving, rig

from gsstream.testing import World

VIEWS = 4
CLOSED = 1e-9


def still(sigma: float, seed: int = 0, views: int = VIEWS) -> World:
    """A scene that stands still in front of noisy cameras."""
    scene, cameras = gaussians(), rig(views)
    clean = images(scene, cameras)
    g = torch.Generator().manual_seed(seed)
    before, now = ([image + sigma * torch.randn(SIZE, SIZE, 3, generator=g) for image in clean] for _ in range(2))
    return context(scene, cameras, before, now, sigma)


def displaced(case: World, row: int, step: float) -> World:
    """The same recording seen by a scene in which one Gaussian stands in the wrong place."""
    means = case.gaussians.means.clone()
    means[row, 1] += step
    return dataclasses.replace(case, gaussians=dataclasses.replace(case.gaussians, means=means))


class TestNoiseNormalised:
    @pytest.mark.parametrize("sigma", [0.002, 0.1])
    def test_a_noisy_still_scene_opens_nothing(self, sigma: float) -> None:
        """The transmitted gate of every Gaussian is 0, though every pixel of every view changed."""
        gate = GumbelSigmoid()
        for seed in range(2):
            z = NoiseNormalised().estimate(still(sigma, seed))
            assert float(gate.sample(gate.init(z), None).max()) == 0.0

    def test_the_ratio_is_one_under_noise(self) -> None:
        """Independent reference: energies of two independent noises have equal expectations."""
        ratios = torch.stack(
            [noise_ratios(still(0.01, seed), 0.001, 1, seed, error=False).change_ratio for seed in range(4)]
        )
        seen = (ratios > 0).all(0)
        assert int(seen.sum()) >= 40
        # Median over draws and Gaussians: the mean of a ratio is raised by small denominators.
        assert float(ratios[:, seen].median()) == pytest.approx(1.0, abs=0.15)

    def test_error_of_a_perfect_scene_is_noise_too(self) -> None:
        found = noise_ratios(still(0.01), 0.001, 4, 0, error=True)
        seen = found.change_ratio > 0
        assert float(found.error_ratio[seen].median()) == pytest.approx(1.0, abs=0.25)

    def test_a_noisier_camera_weighs_less(self) -> None:
        """Each camera is divided by its own noise: one that says it is 1,000 times noisier is all but ignored."""
        case, moved = moving()

        @dataclasses.dataclass(frozen=True)
        class Uneven(World):
            def noise_sigma(self, view: int) -> float:
                return 10.0 if view == 2 else 0.01

        parts = {f.name: getattr(case, f.name) for f in dataclasses.fields(World)}
        now = (*case.now[:2], torch.rand(SIZE, SIZE, 3, generator=torch.Generator().manual_seed(0)))
        spoilt = Uneven(**{**parts, "now": now})
        calm = dataclasses.replace(case, now=now, sigma=0.01)
        z = NoiseNormalised().estimate(spoilt)
        assert float(z[~moved][:30].median()) < float(NoiseNormalised().estimate(calm)[~moved][:30].median())
        assert float((z[moved] > 0).float().mean()) > 0.6

    def test_units_of_the_image_do_not_matter(self) -> None:
        case, _ = moving()
        loud = dataclasses.replace(case, sigma=0.01)
        half = dataclasses.replace(
            loud, before=tuple(i / 2 for i in loud.before), now=tuple(i / 2 for i in loud.now), sigma=0.005
        )
        torch.testing.assert_close(
            NoiseNormalised().estimate(half), NoiseNormalised().estimate(loud), rtol=1e-4, atol=1e-4
        )

    def test_the_least_sigma_bounds_the_ratio(self) -> None:
        case, _ = moving()
        strict = NoiseNormalised(NoiseNormalised.Config(min_sigma=0.1)).estimate(case)
        assert float(strict.max()) < float(NoiseNormalised().estimate(case).max())


class TestErrorAware:
    def test_without_a_budget_it_is_change_alone(self) -> None:
        case, _ = moving()
        loud = dataclasses.replace(case, sigma=0.01)
        change = NoiseNormalised().estimate(loud)
        z = ErrorAware(ErrorAware.Config(budget=0.0)).estimate(loud)
        risen = change > 0
        torch.testing.assert_close(z[risen], change[risen])
        assert bool((z[~risen] == ErrorAware().config.floor).all())

    def test_finds_what_stands_in_the_wrong_place(self) -> None:
        """Nothing moves, the recording is noisy, and one Gaussian was never right: it opens, hardly anybody else."""
        part = ErrorAware(ErrorAware.Config(budget=1 / 60 + CLOSED, turns=1))
        found = 0
        for row in (3, 9, 15):
            case = displaced(still(0.005), row, 0.12)
            opened = (part.estimate(case) == 1.0).nonzero()[:, 0]
            assert len(opened) <= 1
            error = noise_ratios(case, 0.001, 2, 0, error=True).error_ratio
            assert opened.tolist() == [int(error.argmax())]
            found += int(opened[0]) == row
        # Neighbours in front of or behind the misplaced one feel its error as well.
        assert found >= 1

    def test_a_perfect_still_scene_opens_nothing(self) -> None:
        z = ErrorAware(ErrorAware.Config(budget=1.0)).estimate(still(0.01))
        assert bool((z == ErrorAware().config.floor).all())

    def test_budget_and_turns(self) -> None:
        error, changed = torch.linspace(100.0, 41.0, 60, dtype=torch.float64), torch.zeros(60, dtype=torch.bool)
        changed[0] = True
        part = ErrorAware(ErrorAware.Config(budget=0.05, turns=4))
        turns = [part._turn(error, changed, t).tolist() for t in range(8)]
        assert all(len(rows) == 3 for rows in turns)
        # Rows 1 to 12 are the four times three worst that did not change; each comes once in four frames.
        assert sorted(row for rows in turns[:4] for row in rows) == list(range(1, 13))
        assert turns[4:] == turns[:4]

    def test_small_errors_are_left_alone(self) -> None:
        part = ErrorAware(ErrorAware.Config(budget=1.0, turns=1, error_threshold=50.0))
        error = torch.tensor([10.0, 60.0, 50.0, 55.0], dtype=torch.float64)
        assert part._turn(error, torch.zeros(4, dtype=torch.bool), 1).tolist() == [1, 3]


class TestUniformRandom:
    def test_half_are_above_one_half_and_frames_differ(self) -> None:
        scene = gaussians(4000)
        case = context(scene, rig(0), [], [])
        z = UniformRandom().estimate(case)
        assert float((z > 0).float().mean()) == pytest.approx(0.5, abs=4 * 0.5 / 4000**0.5)
        # P(z > logit 0.9) = 0.1.
        assert float((z > 2.1972).float().mean()) == pytest.approx(0.1, abs=4 * 0.3 / 4000**0.5)
        assert not torch.equal(z, UniformRandom().estimate(dataclasses.replace(case, index=2)))
        assert torch.equal(z, UniformRandom().estimate(case))
