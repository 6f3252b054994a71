"""Change scores and cells of births by hand; what is sent is what was fitted; births stay where something changed."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from gsstream_quarc.growth import ChangeGatedCopies, change_scores

from gsstream.api import Cameras, Gaussians
from gsstream.blocks import pixel_size
from gsstream.testing import MethodUnderTest

RNG = np.random.default_rng(0)


def rig(views: int) -> Cameras:
    names = tuple(str(view) for view in range(views))
    return Cameras(names, np.stack([np.eye(4)] * views), np.tile(np.diag([50.0, 50, 1]), (views, 1, 1)), 32, 24)


class Seen:
    """A frame in which every Gaussian has a given gradient along x, in every view."""

    def __init__(self, means: np.ndarray, gradients: list[float], views: int = 7) -> None:
        zeros = torch.zeros(len(means))
        self.gaussians = Gaussians(
            means=torch.from_numpy(means.astype(np.float32)),
            quats=zeros[:, None].repeat(1, 4),
            scales=zeros[:, None].repeat(1, 3),
            opacities=zeros,
            sh0=zeros[:, None, None].repeat(1, 1, 3),
            shN=torch.zeros(len(means), 0, 3),
        )
        self.gradients, self.cameras, self.asked = torch.tensor(gradients), rig(views), []

    def image_change(self, view: int) -> torch.Tensor:
        return torch.full((2, 2, 3), -1.0)

    def screen_gradient(self, view: int, upstream: torch.Tensor):
        assert upstream.unique().tolist() == pytest.approx([2 / 12]), "the gradient of a mean squared error"
        self.asked.append(view)
        return type("Found", (), {"gradient": torch.stack([self.gradients, 0 * self.gradients], 1)})


def admitted(work: Seen, kept: int, rows: torch.Tensor, **settings: Any) -> list[int]:
    return ChangeGatedCopies(ChangeGatedCopies.Config(**settings)).admitted(kept, work, rows).tolist()


def test_scores_compare_with_the_median_of_gradients_that_are_not_zero() -> None:
    work = Seen(RNG.normal(size=(6, 3)), [0.0, 1.0, 2.0, 6.0, 0.0, 0.0])
    assert change_scores(work, 4).tolist() == pytest.approx([0, 1 / 3, 1 / 2, 3 / 4, 0, 0])
    assert work.asked == [0, 2, 4, 6], "four views, spread over the seven"
    few = Seen(RNG.normal(size=(6, 3)), [1.0] * 6, views=2)
    change_scores(few, 4)
    assert few.asked == [0, 1]
    still = change_scores(Seen(np.zeros((2, 3)), [0.0, 0.0]), 4)
    assert still.tolist() == [0, 0]


def test_only_what_changed_may_be_copied_in_the_order_in_which_it_came() -> None:
    means = np.arange(15).reshape(5, 3) * 10.0 + 1
    rows = torch.tensor([4, 0, 2, 1])
    assert admitted(Seen(means, [3.0, 1.0, 0.0, 1.2, 1.5]), 5, rows, score=0.5) == [4, 0]
    assert admitted(Seen(means, [0.0] * 5), 5, rows, score=0.0) == rows.tolist()
    assert admitted(Seen(means, [1.0] * 5), 5, rows[:0], score=0.5) == []


def test_a_cell_takes_so_many_and_remembers_those_of_earlier_rounds() -> None:
    near = np.array([[0.1, 0.1, 5.1]] * 6 + [[100.1, 0.1, 5.1]])
    settings = {"score": 0.0, "per_cell": 2, "pixels": 5}
    work = Seen(near, [1.0] * 7)
    assert 0.3 < 5 * pixel_size(near, work.cameras) < 5
    rows = torch.tensor([3, 6, 0, 1])
    assert admitted(work, 7, rows, **settings) == [3, 6, 0]
    assert admitted(work, 6, rows, **settings) == [3, 6, 0], "the one that was added is in the other cell"
    assert admitted(work, 5, rows, **settings) == [3, 6], "row 5 was added there in this frame"
    assert admitted(work, 3, rows, **settings) == [6], "three were: no room is left"


def test_a_gate_that_lets_everything_through_copies_as_many_as_may_be() -> None:
    found = {}
    for name, gate in (("open", {"per_cell": 1000}), ("one", {"per_cell": 1, "pixels": 1e3})):
        settings = ChangeGatedCopies.Config(gradient=1e-7, rounds=2, most=30, prune_opacity=0.0, score=0.0, **gate)
        method = MethodUnderTest("quarc")
        method.assembly = replace(method.assembly, growth=ChangeGatedCopies(settings))
        found[name] = [step.metrics["added_gaussians"] for step in method.steps[1:]]
    assert found["open"] == [30, 30]
    # Cells this large are the eight octants, each of which takes one in each of two rounds at most.
    assert all(0 < number <= 16 for number in found["one"])
