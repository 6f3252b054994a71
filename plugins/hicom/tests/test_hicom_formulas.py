"""Grids and their motion against hand-made scenes; the number of Gaussians; what is born where."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from gsstream_hicom.motion import CoherentMotion, cell_sides

from gsstream.api import Rng, Scene, apply_motion
from gsstream.parts.growth.copying import high_gradient_rows
from gsstream.testing import motion as bodies
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


def test_where_frames_were_skipped_a_fit_begins_with_the_way_of_all_of_them() -> None:
    part, last = CoherentMotion(), bodies.shifted((1.5, 0.8, 0), (-1.0, 0.7, 0))
    seen = bodies.invisible(bodies.two_bodies(), last)
    skipped = replace(seen, displacement=None, heading=seen.displacement)
    assert bodies.momentum_error(part, skipped, last) <= bodies.TOLERANCE
