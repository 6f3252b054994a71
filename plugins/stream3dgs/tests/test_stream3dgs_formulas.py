"""The hash grid against interpolation by hand, a body that is found again, and Gaussians that live for one frame."""

from __future__ import annotations

import numpy as np
import torch
from gsstream_stream3dgs.cache import PRIMES, Cache, Lookup
from gsstream_stream3dgs.method import Stream3DGS
from gsstream_stream3dgs.motion import fitted_motion, in_box
from gsstream_stream3dgs.settings import BirthSettings, CacheSettings, Stream3DGSConfig

from gsstream.api import Cameras, Gaussians, Layout, Rng, Scene, apply_motion
from gsstream.testing.stepping import MethodUnderTest

RNG = np.random.default_rng(0)
RIG = Cameras(
    ("a", "b"), np.stack([np.eye(4)] * 2), np.tile(np.diag([50.0, 50, 1]), (2, 1, 1)), 32, 24
)  # fmt: skip
SMALL = CacheSettings(levels=5, entries=10, features=2, base=4, width=16, lr=0.01, box=0.0, step=0.01)


def test_the_grid_interpolates_between_the_corners_of_a_cell() -> None:
    unit = torch.from_numpy(RNG.random((20, 3)))
    lookup = Lookup(unit, SMALL)
    np.testing.assert_allclose(lookup.weight.sum(2), 1, atol=1e-6)
    for a, at in enumerate(unit.numpy()):
        for level in range(SMALL.levels):
            cells = int(4 * 2.0**level)
            low = np.floor(at * cells).astype(int)
            for number in range(8):
                step = np.array([number >> 2 & 1, number >> 1 & 1, number & 1])
                near = np.prod(np.where(step == 1, at * cells - low, 1 - (at * cells - low)))
                x, y, z = (int(v) for v in low + step)
                dense = (cells + 1) ** 3 <= 1024
                name = (x * (cells + 1) + y) * (cells + 1) + z if dense else (
                    (x * PRIMES[0]) ^ (y * PRIMES[1]) ^ (z * PRIMES[2])) % 1024
                assert int(lookup.index[a, level, number]) == name + level * 1024
                np.testing.assert_allclose(float(lookup.weight[a, level, number]), near, atol=1e-6)


def test_a_position_on_the_far_face_of_the_box_is_inside() -> None:
    lookup = Lookup(torch.ones(1, 3, dtype=torch.float64), SMALL)
    assert lookup.weight[0].max(1).values.tolist() == [1.0] * 5
    assert int(lookup.index.max()) < 5 * 1024


def test_a_cache_is_at_rest_at_first_and_every_frame_begins_with_the_same() -> None:
    lookup = Lookup(torch.from_numpy(RNG.random((9, 3))), SMALL)
    one, two = (Cache(SMALL, Rng(0).stream("stream3dgs", 0)) for _ in range(2))
    shift, turn = one(lookup)
    assert not shift.any()
    assert not turn.any()
    for a, b in zip(one.parameters(), two.parameters(), strict=True):
        assert torch.equal(a, b)


def test_the_box_leaves_out_what_lies_far_away() -> None:
    means = np.concatenate([RNG.uniform(0, 1, (98, 3)), [[50, 0.5, 0.5], [0.5, -50, 0.5]]])
    unit, inside = in_box(means, 0.02)
    assert not inside[98:].any()
    assert inside[:98].mean() > 0.8
    assert ((unit[inside] >= 0) & (unit[inside] <= 1)).all()


class Pulled:
    """A frame whose loss is the squared distance of every Gaussian to where it belongs."""

    cameras, index = RIG, 1

    def __init__(self, aims: np.ndarray) -> None:
        self.aims = torch.from_numpy(aims.astype(np.float32))

    def narrow(self, rows: torch.Tensor) -> None:
        self.rows = rows

    def pull(self, view: int, rows: Gaussians[torch.Tensor]) -> float:
        loss = (rows.means - self.aims[self.rows]).square().sum()
        loss.backward()
        return float(loss.detach())


def test_two_bodies_find_their_own_ways() -> None:
    means = np.concatenate([RNG.normal((0, 0, 3), 0.02, (40, 3)), RNG.normal((0.5, 0, 3), 0.02, (40, 3))])
    aims = means + np.repeat([[0.03, 0, 0.01], [-0.02, 0.04, 0]], 40, 0)
    quats = np.tile(np.float32([1, 0, 0, 0]), (80, 1))
    gaussians = Gaussians(
        means=means.astype(np.float32), quats=quats, scales=np.zeros((80, 3), np.float32),
        opacities=np.zeros(80, np.float32), sh0=np.zeros((80, 1, 3), np.float32), shN=np.zeros((80, 0, 3), np.float32),
    )  # fmt: skip
    scene = Scene(gaussians, Layout(np.ones(80, np.int32), np.zeros(80, np.uint8), np.float32([1])))
    motion = fitted_motion(scene, Pulled(aims), np.arange(80), 60, SMALL, Rng(0))
    assert motion is not None
    after = apply_motion(scene, motion)[0].gaussians.means
    assert np.abs(after - aims).mean() < 0.3 * np.abs(means - aims).mean()
    assert fitted_motion(scene, Pulled(means), np.zeros(0, np.int64), 1, SMALL, Rng(0)) is None


def test_births_live_for_one_frame() -> None:
    births = BirthSettings(gradient=1e-7, rounds=1, most=7, prune_opacity=0.0)
    small = CacheSettings(levels=2, entries=6, width=4)
    first, second, third = MethodUnderTest("stream3dgs", Stream3DGS(Stream3DGSConfig(cache=small, births=births))).steps
    number = len(first.state.player.gaussians)
    assert second.metrics["births"] == third.metrics["births"] == third.metrics["deaths"] == 7
    assert len(second.state.player.gaussians) == len(third.state.player.gaussians) == number + 7
    assert third.state.player.delta.deaths.tolist() == list(range(number, number + 7))
    opacities = [step.state.player.gaussians.opacities[:number].tobytes() for step in (first, second, third)]
    assert len(set(opacities)) == 1, "those of frame 0 stay as they are, but for their places"
