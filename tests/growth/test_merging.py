"""Merges: what the one Gaussian has of the two, which pairs are taken, and that they make room for births."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gsstream.core.changes import Layout, Scene
from gsstream.core.gaussians import Gaussians
from gsstream.growth.merging import closest_pairs, merged
from gsstream.growth.splitting import halves

PAIR = np.array([[0, 1]])


def some(number: int, seed: int) -> Gaussians[np.ndarray]:
    rng = np.random.default_rng(seed)
    values = {
        "means": rng.normal(size=(number, 3)),
        "quats": rng.normal(size=(number, 4)) * rng.uniform(0.1, 10, (number, 1)),
        "scales": rng.normal(-2, 1, (number, 3)),
        "opacities": rng.normal(0, 2, number),
        "sh0": rng.normal(size=(number, 1, 3)),
        "shN": rng.normal(size=(number, 3, 3)),
    }
    return Gaussians(**{name: value.astype(np.float32) for name, value in values.items()})


def covariance(gaussians: Gaussians[np.ndarray], row: int) -> np.ndarray:
    turn = Rotation.from_quat(np.roll(gaussians.quats[row].astype(float), -1)).as_matrix()
    return turn @ np.diag(np.exp(2 * gaussians.scales[row].astype(float))) @ turn.T


@given(st.integers(0, 10_000))
@settings(max_examples=20)
def test_one_has_the_mean_and_the_spread_of_many_points_of_both(seed: int) -> None:
    """Points drawn from the two, as many of each as it has light, know nothing of the formulas."""
    two = some(2, seed)
    two = replace(two, scales=two.scales.clip(-3, 0))
    one = merged(two, PAIR)
    rng = np.random.default_rng(seed)
    light = [
        float(np.exp(np.sort(two.scales[i])[1:].sum()) / (1 + np.exp(-two.opacities[i]))) for i in range(2)
    ]
    numbers = np.rint(50_000 * np.array(light) / sum(light)).astype(int)
    points = np.concatenate([
        rng.multivariate_normal(two.means[i], covariance(two, i), size=number) for i, number in enumerate(numbers)
    ])
    size = np.sqrt(np.trace(np.cov(points.T)))
    assert np.allclose(one.means[0], points.mean(0), atol=0.03 * size)
    assert np.allclose(covariance(one, 0), np.cov(points.T), atol=0.05 * size**2)
    assert np.isclose(np.linalg.det(Rotation.from_quat(np.roll(one.quats[0], -1)).as_matrix()), 1)


def test_two_in_one_place_are_one_behind_the_other() -> None:
    twins = some(1, 3).rows(np.array([0, 0]))
    one = merged(twins, PAIR)
    opacity = 1 / (1 + np.exp(-twins.opacities[0]))
    assert np.allclose(1 / (1 + np.exp(-one.opacities[0])), min(1 - (1 - opacity) ** 2, 0.99), atol=1e-5)
    assert np.allclose(one.means[0], twins.means[0], atol=1e-6)
    assert np.allclose(covariance(one, 0), covariance(twins, 0), rtol=1e-4, atol=1e-7)
    assert np.allclose(one.sh0[0], twins.sh0[0], atol=1e-6)
    assert np.allclose(one.shN[0], twins.shN[0], atol=1e-6)


def test_halves_are_made_whole_again() -> None:
    parent = some(1, 5)
    one = merged(halves(parent), PAIR)
    assert np.allclose(one.means, parent.means, atol=1e-5)
    assert np.allclose(covariance(one, 0), covariance(parent, 0), rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("change", [{"scales": -30.0}, {"opacities": -90.0}, {"opacities": 90.0}, {"quats": 0.0}])
def test_extremes_stay_finite(change: dict[str, float]) -> None:
    two = some(2, 7)
    for name, value in change.items():
        two = replace(two, **{name: np.full_like(getattr(two, name), value)})
    one = merged(two, PAIR)
    assert all(np.isfinite(value).all() for _, value in one.items())


def test_no_pairs_give_nobody() -> None:
    assert len(merged(some(4, 0), np.zeros((0, 2), np.int64))) == 0


def scene_of(gaussians: Gaussians[np.ndarray]) -> Scene:
    """A scene of one node."""
    number = len(gaussians)
    layout = Layout(np.array([number], np.int32), np.zeros(number, np.uint8), np.array([0.1], np.float32))
    return Scene(gaussians, layout)


@given(st.integers(0, 10_000), st.integers(2, 60), st.integers(0, 20))
def test_pairs_share_nobody_and_leave_out_whom_they_should(seed: int, number: int, wanted: int) -> None:
    out = np.random.default_rng(seed).permutation(number)[: number // 3]
    pairs = closest_pairs(scene_of(some(number, seed)), wanted, out)
    assert len(pairs) <= wanted
    assert len(np.unique(pairs)) == pairs.size
    assert not np.isin(pairs, out).any()


def test_twins_come_first_and_are_not_paired_with_themselves() -> None:
    rows = np.concatenate([np.arange(40), [7, 7]])
    pairs = closest_pairs(scene_of(some(40, 1).rows(rows)), 1, np.zeros(0, np.int64))
    assert len(set(pairs[0])) == 2
    assert set(pairs[0]) <= {7, 40, 41}


@pytest.mark.parametrize("number", [0, 1])
def test_who_is_alone_has_no_pair(number: int) -> None:
    assert closest_pairs(scene_of(some(number, 0)), 5, np.zeros(0, np.int64)).shape == (0, 2)
