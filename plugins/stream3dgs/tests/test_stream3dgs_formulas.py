"""The cache beside what players compute, a body that is found again, and Gaussians that live for one frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from gsstream_stream3dgs.cache import Cache, Lookup
from gsstream_stream3dgs.motion import CacheMotion

from gsstream.api import Delta, Rng, Scene, apply_delta, apply_field, field_rows
from gsstream.blocks import transform_rows
from gsstream.testing import MethodUnderTest
from tests.scenes import RIG, SquaredDistances, scene_at

RNG = np.random.default_rng(0)
SMALL = CacheMotion.Config(levels=5, entries=10, features=2, base=4, width=16, lr=0.01, box=0.0, step=0.01)


def cache_of(means: np.ndarray, entry_step: float = 1e-6, weight_step: float = 1e-4) -> tuple[Scene, Cache]:
    scene = scene_at(means)
    shape = CacheMotion(SMALL).shape(scene, RIG.extent, Rng(0))
    _, unit = field_rows(scene, shape, None)
    return scene, Cache(shape, Lookup(shape, unit), entry_step, weight_step)


@pytest.mark.parametrize("rounded", [False, True])
@pytest.mark.parametrize("step", [1e-5, 0.02])
def test_what_is_trained_is_what_players_show(step, rounded):
    """The cache in torch beside the numpy function of every player: equal but for rounding, coarse steps or fine."""
    scene, cache = cache_of(RNG.normal(size=(60, 3)), step, max(step, 2.0**-14))
    torch.manual_seed(0)
    with torch.no_grad():
        for value in cache.learned:
            value += 0.1 * torch.randn_like(value)
        shift, turn = cache(rounded)
    after, rows = apply_field(scene, cache.field(None))
    assert len(rows) == 60
    wanted = transform_rows(scene.gaussians.map(torch.from_numpy), cache.shape.reach * shift, turn)
    there = np.abs(after.gaussians.means - wanted.means.numpy()).max() / cache.shape.reach
    turned = np.abs(after.gaussians.quats - wanted.quats.numpy()).max()
    assert float(shift.abs().max()) > 0.05
    if rounded or step < 1e-3:
        assert (there, turned) < (2e-3, 2e-3)
    else:
        assert there > 2e-3, "a coarse step would show if training did not know of it"


def test_gradients_pass_the_rounding():
    _, cache = cache_of(RNG.normal(size=(30, 3)), 0.5, 0.5)
    shift, _ = cache(rounded=True)
    shift.sum().backward()
    assert all(value.grad is not None for value in cache.learned[1:])
    assert float(cache.learned[-1].grad.abs().max()) > 0
    cache.step(0.1)
    assert float(cache.learned[-1].detach().abs().max()) == pytest.approx(0.1, rel=1e-3)
    assert all(value.grad is None for value in cache.learned)


def test_its_steps_are_those_of_adam():
    """Against the formulas of Kingma and Ba in float64, over ten steps; what gets no gradient stays."""
    _, cache = cache_of(RNG.normal(size=(5, 3)))
    theirs = [value.detach().numpy().astype(np.float64) for value in cache.learned]
    first, second = ([np.zeros_like(value) for value in theirs] for _ in range(2))
    for count in range(1, 11):
        for at, mine in enumerate(cache.learned):
            if not at:
                continue
            grad = RNG.normal(size=mine.shape)
            mine.grad = torch.from_numpy(grad.astype(np.float32))
            first[at] = 0.9 * first[at] + 0.1 * grad
            second[at] = 0.999 * second[at] + 0.001 * grad**2
            step = (first[at] / (1 - 0.9**count)) / (np.sqrt(second[at] / (1 - 0.999**count)) + 1e-8)
            theirs[at] -= 0.01 * step
        cache.step(0.01)
    assert not cache.learned[0].detach().any()
    for mine, other in zip(cache.learned, theirs, strict=True):
        np.testing.assert_allclose(mine.detach().numpy(), other, atol=1e-5)


def test_a_cache_is_at_rest_at_first_and_every_frame_begins_with_the_same() -> None:
    means = RNG.normal(size=(9, 3))
    (_, one), (_, two) = cache_of(means), cache_of(means)
    shift, turn = one()
    assert not shift.any()
    assert not turn.any()
    for a, b in zip(one.starts, two.starts, strict=True):
        assert torch.equal(a, b)
    other = CacheMotion(SMALL).shape(scene_at(means), RIG.extent, Rng(1))
    assert other.seed != one.shape.seed


def test_the_box_leaves_out_what_lies_far_away() -> None:
    means = np.concatenate([RNG.uniform(0, 1, (98, 3)), [[50, 0.5, 0.5], [0.5, -50, 0.5]]])
    wide = SMALL.model_copy(update={"box": 0.02})
    rows, unit = field_rows(scene_at(means), CacheMotion(wide).shape(scene_at(means), RIG.extent, Rng(0)), None)
    assert not set(rows) & {98, 99}
    assert len(rows) > 80
    assert ((unit >= 0) & (unit <= 1)).all()


@pytest.mark.parametrize("means", [np.zeros((1, 3)), np.ones((7, 3)) * [[1e6, -1e6, 0.1]]])
def test_a_scene_without_extent_has_a_box(means) -> None:
    scene = scene_at(means)
    shape = CacheMotion(SMALL).shape(scene, RIG.extent, Rng(0))
    assert shape.problem() is None
    assert len(field_rows(scene, shape, None)[0]) == len(means)


@pytest.mark.parametrize("sent", ["field", "cells"])
def test_two_bodies_find_their_own_ways(sent) -> None:
    means = np.concatenate([RNG.normal((0, 0, 3), 0.02, (40, 3)), RNG.normal((0.5, 0, 3), 0.02, (40, 3))])
    aims = means + np.repeat([[0.03, 0, 0.01], [-0.02, 0.04, 0]], 40, 0)
    scene, settings = scene_at(means), SMALL.model_copy(update={"sent": sent, "epochs": 40})
    found = CacheMotion(settings).propose(scene, SquaredDistances(scene, aims), Rng(0))
    after = apply_delta(scene, Delta(found)).gaussians.means
    assert np.abs(after - aims).mean() < 0.3 * np.abs(means - aims).mean()
    nothing = SquaredDistances(scene, means, np.zeros(0, np.int64))
    assert CacheMotion(settings).propose(scene, nothing, Rng(0)) == ()


def test_only_what_changed_moves_and_nothing_that_was_added() -> None:
    means = RNG.normal((0, 0, 3), 0.02, (40, 3))
    scene, some = scene_at(means), np.arange(0, 40, 3)
    work = SquaredDistances(scene, means + 0.03, some, key_rows=31)
    found = CacheMotion(SMALL.model_copy(update={"epochs": 5})).propose(scene, work, Rng(0))
    after = apply_delta(scene, Delta(found)).gaussians.means
    assert np.flatnonzero((after != scene.gaussians.means).any(1)).tolist() == some[some < 31].tolist()


def test_what_a_frame_adds_is_there_for_that_frame_alone() -> None:
    method = MethodUnderTest("stream3dgs")
    copies = type(method.assembly.part("growth"))
    growth = copies(copies.Config(gradient=1e-7, rounds=1, most=7, prune_opacity=0.0, leave="last-added"))
    small = CacheMotion(CacheMotion.Config(levels=2, entries=6, width=4))
    method.assembly = replace(method.assembly, motion=small, growth=growth)
    first, second, third = method.steps
    number = len(first.state.player.gaussians)
    assert [step.metrics["added_gaussians"] for step in (second, third)] == [7, 7]
    assert third.state.player.delta.removed.tolist() == list(range(number, number + 7))
    opacities = [step.state.player.gaussians.opacities[:number].tobytes() for step in (first, second, third)]
    assert len(set(opacities)) == 1, "those of frame 0 stay as they are, but for their places"
    assert second.state.player.delta.field is not None
