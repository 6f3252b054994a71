"""Grids and their motion against hand-made scenes; the number of Gaussians; what is born where."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from gsstream_hicom.motion import CoherentMotion, cell_sides

from gsstream.api import Displacement, Rng, Scene, apply_motion
from gsstream.blocks import high_gradient_rows
from tests.scenes import RIG, SquaredDistances, scene_at

RNG = np.random.default_rng(0)


def cloud(number: int, at: tuple[float, float, float], width: float = 0.02) -> np.ndarray:
    return RNG.normal(at, width, (number, 3))


def after(scene: Scene, work: SquaredDistances, **settings: Any) -> Scene:
    """Return the scene after what the part proposes."""
    part = CoherentMotion(CoherentMotion.Config(**{"measure": "cell", **settings}))
    for motion in part.propose(scene, work, Rng(0)):
        scene = apply_motion(scene, motion)[0]
    return scene


def test_the_finest_cells_hold_as_many_as_asked_for_and_each_grid_is_twice_as_wide() -> None:
    means = RNG.uniform(0, 1, (20_000, 3))
    sides = cell_sides(means, 3, 5.0)
    assert sides == pytest.approx([4 * sides[2], 2 * sides[2], sides[2]])
    # 90 % along each axis lie in the box whose volume is shared by all.
    assert 20_000 * sides[2] ** 3 / 0.9**3 == pytest.approx(5, rel=0.02)


@pytest.mark.parametrize("levels", [1, 3])
def test_two_bodies_find_their_own_ways(levels: int) -> None:
    """Two clouds far apart move differently; a coarse cell holds both, and finer ones tell them apart."""
    one, two = cloud(40, (0, 0, 3)), cloud(40, (0.5, 0, 3))
    means = np.concatenate([one, two])
    aims = means + np.repeat([[0.03, 0, 0.01], [-0.02, 0.04, 0]], 40, 0)
    scene = scene_at(means)
    work = SquaredDistances(scene, aims)
    there = after(scene, work, levels=levels, lr=0.1, step=0.01, epochs=60)
    assert np.abs(there.gaussians.means - aims).mean() < 0.3 * np.abs(means - aims).mean()


def test_a_frame_begins_with_a_share_of_the_last_ones_motion() -> None:
    means = cloud(60, (0, 0, 3), 0.05)
    shift = np.tile(np.float32([0.05, 0, 0]), (60, 1))
    moved = Displacement(np.arange(60), shift, np.zeros_like(shift))
    scene = scene_at(means, moved)
    work = SquaredDistances(scene, means + 0.6 * shift)
    slow = {"lr": 1e-6, "step": 0.01, "epochs": 3}
    there = after(scene, work, momentum=0.6, **slow)
    np.testing.assert_allclose(there.gaussians.means, means + 0.6 * shift, atol=1e-3)
    still = after(scene, work, momentum=0.0, **slow)
    np.testing.assert_array_equal(still.gaussians.means, scene.gaussians.means)


def test_only_cells_in_what_changed_move() -> None:
    means = np.concatenate([cloud(30, (0, 0, 3)), cloud(30, (1, 0, 3))])
    scene = scene_at(means)
    work = SquaredDistances(scene, means + np.array([0.05, 0, 0]), changed=np.arange(30))
    there = after(scene, work, epochs=9)
    assert (there.gaussians.means[:30] != scene.gaussians.means[:30]).any(1).mean() > 0.5
    np.testing.assert_array_equal(there.gaussians.means[30:], scene.gaussians.means[30:])


class Shown:
    """One view of three Gaussians with given screen gradients."""

    cameras = RIG.select([0])
    gaussians = scene_at(np.zeros((3, 3))).gaussians.map(torch.from_numpy)
    shell_rows = torch.zeros(3, dtype=torch.bool)

    def previous_render(self, view: int) -> torch.Tensor:
        return torch.ones(2, 2, 3)

    def image(self, view: int) -> torch.Tensor:
        return torch.zeros(2, 2, 3)

    def screen_gradient(self, view: int, upstream: torch.Tensor):
        assert upstream.unique().tolist() == pytest.approx([1 / 12]), "the gradient of a mean absolute difference"
        return type("Found", (), {"gradient": torch.tensor([[0.0, 0.001], [0.01, 0.0], [0.0, 0.0]])})


def test_copies_are_made_where_the_gradient_in_half_widths_exceeds_the_bound() -> None:
    assert high_gradient_rows(Shown(), 0.01).tolist() == [1, 0], "0.16 and 0.012; the largest first"
    assert high_gradient_rows(Shown(), 0.1).tolist() == [1]
    assert high_gradient_rows(Shown(), 0.2).tolist() == []
