"""Groups that move as one are found and held together; what each step does is compared with the whole system."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.linalg import block_diag
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from gsstream.parts.motion.bodies import Bodies, form_bodies
from gsstream.parts.motion.newton import BodySettings, DampedNewton, Damping

UNIT = np.array([0.01] * 3 + [0.01 / 0.5] * 3)  # cells of 0.5 scene units
RNG = np.random.default_rng


def grid(number: tuple[int, int, int], seed: int = 0) -> np.ndarray:
    """Centres of groups in neighbouring cells [K, 3], far from the origin."""
    cells = np.stack(np.meshgrid(*map(np.arange, number), indexing="ij"), -1).reshape(-1, 3)
    return np.asarray(0.5 * cells + RNG(seed).uniform(-0.05, 0.05, cells.shape) + [30.0, -7.0, 4.0])


def curvatures(number: int, seed: int, views: int = 4) -> np.ndarray:
    """[K, 6, 6] of groups that are seen from a few sides each."""
    roots = RNG(seed).standard_normal((number, 6, 2 * views))
    return np.asarray(50 * roots @ roots.transpose(0, 2, 1) + np.eye(6))


def moved_by(center: np.ndarray, vector: np.ndarray, about: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """[K, 6] shift and turn, in units, of groups of one rigid body: a rotation vector about a point, then a shift."""
    turn = Rotation.from_rotvec(vector)
    there = turn.apply(center - about) + about + shift - center
    angle = np.linalg.norm(vector)
    tangent = np.tan(angle / 2) / angle * vector
    return np.concatenate([there, np.broadcast_to(tangent, there.shape)], 1) / UNIT


def two_bodies(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centres, motions, and which of two bodies each group is of."""
    center = grid((8, 2, 2))
    which = (center[:, 0] > np.median(center[:, 0])).astype(int)
    rng = RNG(seed)
    arm = moved_by(center, rng.uniform(-0.06, 0.06, 3), rng.uniform(-3, 3, 3), rng.uniform(-0.2, 0.2, 3))
    hand = moved_by(center, rng.uniform(-0.06, 0.06, 3), rng.uniform(-3, 3, 3), rng.uniform(-0.2, 0.2, 3))
    return center, np.where(which[:, None] == 0, arm, hand), which


@pytest.mark.parametrize("seed", range(4))
def test_two_rigid_bodies_are_told_apart_and_each_keeps_its_motion(seed: int) -> None:
    center, values, which = two_bodies(seed)
    found = form_bodies(center, UNIT, values, curvatures(len(center), seed), 100.0)
    assert found.body.tolist() == which.tolist()
    np.testing.assert_allclose(found.values, values, atol=1e-6 * np.abs(values).max())


@pytest.mark.parametrize("seed", range(4))
def test_noise_that_the_pictures_do_not_hold_against_is_removed(seed: int) -> None:
    center, truth, which = two_bodies(seed)
    curvature = curvatures(len(center), seed)
    # Noise as a fit has it, of the size that the curvature allows.
    root = np.linalg.cholesky(curvature).transpose(0, 2, 1)
    noise = np.linalg.solve(root, RNG(seed).standard_normal((len(center), 6, 1)))[..., 0]
    found = form_bodies(center, UNIT, truth + noise, curvature, 100.0)
    assert found.body.tolist() == which.tolist()
    gap = found.values - truth
    left, before = (np.einsum("ki,kij,kj->", each, curvature, each) for each in (gap, noise))
    assert left < 0.2 * before, "32 groups of 6 numbers have become two bodies of 6"


@pytest.mark.parametrize("seed", range(3))
def test_a_pair_is_joined_exactly_when_its_best_common_motion_costs_less_than_allowed(seed: int) -> None:
    center, rng = grid((2, 1, 1)), RNG(seed)
    values, curvature = 0.05 * rng.standard_normal((2, 6)), curvatures(2, seed)
    lever = form_bodies(center, UNIT, values, curvature, 0.0).lever

    def loss(motion: np.ndarray) -> float:
        away = (lever @ motion) - values
        return float(0.5 * np.einsum("ki,kij,kj->", away, curvature, away))

    # Turns are so small here that shifts are linear in them.
    cost = minimize(loss, np.zeros(6), method="BFGS", options={"gtol": 1e-9}).fun
    assert form_bodies(center, UNIT, values, curvature, 0.98 * cost).body.tolist() == [0, 1]
    assert form_bodies(center, UNIT, values, curvature, 1.02 * cost).body.tolist() == [0, 0]


def test_bodies_do_not_depend_on_how_groups_are_numbered() -> None:
    center, values, _ = two_bodies(7)
    values = values + 0.3 * RNG(7).standard_normal(values.shape)
    curvature, order = curvatures(len(center), 7), RNG(8).permutation(len(center))
    one = form_bodies(center, UNIT, values, curvature, 30.0)
    other = form_bodies(center[order], UNIT, values[order], curvature[order], 30.0)
    assert 2 < one.body.max() < len(center) - 2, "some groups are joined and some are not"
    same = one.body[:, None] == one.body
    assert np.array_equal(same[np.ix_(order, order)], other.body[:, None] == other.body)
    np.testing.assert_allclose(other.values, one.values[order], atol=1e-6)


def test_groups_that_are_not_neighbours_stay_apart_though_they_move_alike() -> None:
    center = grid((5, 1, 1))[[0, 1, 3, 4]]
    values = moved_by(center, np.array([0.0, 0.1, 0.0]), center[0], np.zeros(3))
    assert form_bodies(center, UNIT, values, curvatures(4, 0), 1e9).body.tolist() == [0, 0, 1, 1]


@pytest.mark.parametrize("number", [(1, 1, 1), (3, 3, 3)])
def test_groups_that_are_all_alike_become_one_body_and_stand_where_they_stood(number: tuple[int, int, int]) -> None:
    """All pairs cost the same, nothing: no group may be joined to two others at once."""
    center = grid(number)
    curvature = np.tile(np.eye(6), (len(center), 1, 1))
    found = form_bodies(center, UNIT, np.zeros((len(center), 6)), curvature, 1.0)
    assert not found.body.any()
    assert not found.values.any()


def whole_system(
    bodies: Bodies, away: np.ndarray, grad: np.ndarray, matrix: np.ndarray, spring: float, seen: int
) -> np.ndarray:
    """[K, 6] steps of the groups: the minimum over groups and bodies, as one dense system of linear equations."""
    groups, number = len(away), int(bodies.body.max()) + 1
    pick = np.zeros((6 * groups, 6 * number))
    for group, body in enumerate(bodies.body):
        pick[6 * group : 6 * group + 6, 6 * body : 6 * body + 6] = bodies.lever[group]
    apart = np.concatenate([np.eye(6 * groups), -pick], 1)  # group - body
    system = seen * spring * apart.T @ apart
    system[: 6 * groups, : 6 * groups] += block_diag(*matrix)
    slope = spring * apart.T @ away.ravel()
    slope[: 6 * groups] += grad.ravel()
    return np.asarray(np.linalg.solve(system, -slope)[: 6 * groups].reshape(groups, 6))


def with_damping(total: np.ndarray) -> np.ndarray:
    """[K, 6, 6] curvature with what ``Damping(0.1, 40, ...)`` adds to it."""
    mean = np.trace(total, axis1=1, axis2=2) / 6
    added = 0.1 * np.maximum(mean, mean.mean()) + 40.0
    return np.asarray(total + added[:, None, None] * np.eye(6))


@pytest.mark.parametrize("stiffness", [3.0, 500.0, 1e5])
def test_a_step_of_held_groups_solves_the_whole_system(stiffness: float) -> None:
    center, values, _ = two_bodies(2)
    views, rng = 3, RNG(2)
    curvature = curvatures(len(center), 2)
    descent = DampedNewton(torch.from_numpy(values + 0.3 * rng.standard_normal(values.shape)), Damping(0.1, 40.0, 1e9))
    for view in range(views):
        descent.step(torch.zeros_like(descent.values), torch.from_numpy(curvature) * (view + 1))
    fitted, total = descent.values.numpy(), 6 * curvature
    damped = with_damping(total)
    bodies = form_bodies(center, UNIT, fitted, damped, 100.0)
    descent.join_neighbours(center, UNIT, BodySettings(100.0, stiffness))
    pulled = np.linalg.solve(damped + stiffness * np.eye(6), damped @ (fitted - bodies.values)[..., None])[..., 0]
    np.testing.assert_allclose(descent.values, bodies.values + pulled, atol=1e-9)

    away, before = pulled, descent.values.numpy()
    for seen in (2, 3):
        grad = rng.standard_normal(values.shape)
        step = whole_system(bodies, away, grad, with_damping(2 * seen * curvature), stiffness / views, seen)
        descent.step(torch.from_numpy(grad))
        np.testing.assert_allclose(descent.values, before + step, atol=1e-7 * max(1.0, np.abs(step).max()))
        before = descent.values.numpy()
        away = away + step - along(bodies, away, step, spring=stiffness / views, seen=seen)


def along(bodies: Bodies, away: np.ndarray, step: np.ndarray, spring: float, seen: int) -> np.ndarray:
    """[K, 6] where bodies take their groups: the least squares of what springs feel, given the steps of the groups."""
    out = np.zeros_like(step)
    for body in range(int(bodies.body.max()) + 1):
        own = bodies.body == body
        lever = bodies.lever[own].reshape(-1, 6)
        goal = (step + away / seen)[own].ravel()
        out[own] = (lever @ np.linalg.lstsq(lever, goal, rcond=None)[0]).reshape(-1, 6)
    return out


def test_no_number_of_a_held_group_moves_further_than_the_longest_step() -> None:
    center, values, which = two_bodies(3)
    descent = DampedNewton(torch.from_numpy(values), Damping(0.1, 40.0, 0.5))
    descent.step(torch.zeros_like(descent.values), torch.from_numpy(curvatures(len(center), 3)))
    descent.join_neighbours(center, UNIT, BodySettings(100.0, 500.0))
    before = descent.values
    grad = torch.zeros_like(before)
    grad[which == 0, 0] = 1e9
    descent.step(grad)
    step = (descent.values - before).abs().amax(1)
    assert float(step.max()) == pytest.approx(0.5)
    assert float(step[torch.from_numpy(which == 1)].max()) < 1e-9, "the other body stays where it is"
