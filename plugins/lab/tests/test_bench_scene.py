"""What the benchmarks stand on: scenes of known statistics, counts that are right, floors that follow from them."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch
from gsstream_lab.bench.roofline import (
    FLOPS_PER_PAIR,
    FLOPS_PER_VISIBLE,
    Peak,
    central_tiles,
    footprints,
    live_pairs,
    pixels_of,
    roofline_ms,
)
from gsstream_lab.bench.scene import (
    OBJECT_ROOM,
    Points,
    arc_rig,
    make_gaussians,
    morton_order,
    neighbour_spacing,
    object_points,
    synthetic_points,
)
from gsstream_lab.bench.timing import Steps, interleaved
from hypothesis import given, settings
from hypothesis import strategies as st

from gsstream.core.gaussians import Gaussians
from gsstream.parts.backend.reference import ALPHA_CUT, ALPHA_MAX, TRANSMITTANCE_MIN, project


def scene(count: int = 300, seed: int = 0) -> Gaussians[np.ndarray]:
    return make_gaussians(synthetic_points(count, seed), seed)


def test_the_same_seed_gives_the_same_scene_and_another_seed_another() -> None:
    first, again, other = scene(), scene(), scene(seed=1)
    first.validate()
    for (name, a), (_, b), (_, c) in zip(first.items(), again.items(), other.items(), strict=True):
        assert a.dtype == np.float32, name
        assert a.tobytes() == b.tobytes(), name
        assert a.tobytes() != c.tobytes(), name


def test_a_scene_has_the_statistics_it_promises() -> None:
    made = make_gaussians(synthetic_points(20_000, 0), 0)
    widths = np.exp(made.scales)
    assert 3 < np.median(widths.max(1) / widths.min(1)) < 30, "thin in one axis"
    opacities = 1 / (1 + np.exp(-made.opacities))
    assert (opacities < 0.3).mean() > 0.25
    assert (opacities > 0.85).mean() > 0.25
    steps = np.linalg.norm(np.diff(made.means, axis=0), axis=1)
    shuffled = made.means[np.random.default_rng(0).permutation(20_000)]
    assert np.median(steps) < 0.1 * np.median(np.linalg.norm(np.diff(shuffled, axis=0), axis=1)), "Morton order"
    assert np.linalg.norm(made.means, axis=1).min() > 0.7 * OBJECT_ROOM, "room for the object"
    seen = footprints(made, arc_rig(1, 320, 240)).visible.mean()
    assert 0.3 < seen < 0.9


def test_static_parts_of_any_size_lie_on_the_same_surfaces() -> None:
    few, many = synthetic_points(500, 3).xyz, synthetic_points(50_000, 3).xyz
    distances = np.stack([np.linalg.norm(many - point, axis=1).min() for point in few])
    assert np.quantile(distances, 0.9) < 0.4


def test_the_object_is_seen_by_every_camera() -> None:
    made = make_gaussians(object_points(50, 0), 0)
    assert footprints(made, arc_rig(1, 80, 60)).visible.all()


@given(st.integers(2, 60), st.integers(0, 2**31))
@settings(max_examples=30, deadline=None)
def test_order_and_spacing_of_any_points(count: int, seed: int) -> None:
    xyz = np.random.default_rng(seed).integers(-3, 4, (count, 3)).astype(float)  # repeated and coplanar ones among them
    order = morton_order(xyz)
    assert sorted(order.tolist()) == list(range(count))
    spacing = neighbour_spacing(xyz[order])
    assert np.isfinite(spacing).all()
    assert (spacing > 0).all()


def test_live_pairs_are_those_of_a_naive_count() -> None:
    made, camera = scene(120), arc_rig(1, 40, 30)
    counts = live_pairs(footprints(made, camera))
    means2d, conics, _, depths, opacities = project(made.map(torch.from_numpy), camera, 0)
    naive = np.zeros((30, 40), np.int64)
    order = [i for i in torch.argsort(depths, stable=True).tolist() if depths[i] > camera.near_plane]
    for y in range(30):
        for x in range(40):
            light = 1.0
            for i in order:
                d = torch.tensor([x + 0.5, y + 0.5]) - means2d[i]
                alpha = float(opacities[i] * torch.exp(-0.5 * d @ conics[i] @ d))
                if light > TRANSMITTANCE_MIN and alpha >= ALPHA_CUT:
                    naive[y, x] += 1
                    light *= 1 - min(alpha, ALPHA_MAX)
    assert naive.sum() > 1000
    assert np.abs(naive - counts).sum() <= 2, "only float32 against float64 at the cut may differ"


def test_central_tiles_grow_from_the_middle_and_hold_their_share() -> None:
    masks = [central_tiles(320, 240, share) for share in (0.02, 0.05, 0.25, 1.0)]
    assert [int(mask.sum()) for mask in masks] == [6, 15, 75, 300]
    for small, large in pairwise(masks):
        assert not (small & ~large).any()
    assert central_tiles(20, 20, 1e-6).sum() == 1
    assert pixels_of(central_tiles(20, 35, 1.0), 20, 35).shape == (35, 20)


def test_rows_that_move_have_their_centre_in_the_tiles() -> None:
    made = footprints(scene(2000), arc_rig(1, 64, 48))
    mask = central_tiles(64, 48, 0.25)
    rows = made.in_tiles(mask)
    assert 0 < len(rows) < made.visible.sum()
    tile = (made.means2d[rows] // 16).astype(int)
    assert mask[tile[:, 1], tile[:, 0]].all()
    assert (np.diff(rows) > 0).all()


def test_the_floor_is_counted_work_over_peaks() -> None:
    peak = Peak(1, gflops=2.0, gbytes_per_second=4.0)
    forward, backward = roofline_ms(peak, pairs=10**6, visible=0, rows=0, pixels=0, floats=38)
    assert forward == pytest.approx(FLOPS_PER_PAIR[0] * 1e6 / 2e9 * 1e3)
    assert backward == pytest.approx(FLOPS_PER_PAIR[1] * 1e6 / 2e9 * 1e3)
    forward, backward = roofline_ms(peak, pairs=0, visible=1000, rows=10**6, pixels=10**6, floats=38)
    assert forward == pytest.approx(FLOPS_PER_VISIBLE[0] * 1e3 / 2e9 * 1e3 + (38 + 4) * 4e6 / 4e9 * 1e3)
    assert backward == pytest.approx(FLOPS_PER_VISIBLE[1] * 1e3 / 2e9 * 1e3 + (2 * 38 + 4) * 4e6 / 4e9 * 1e3)


def test_cases_take_turns_and_warm_up_does_not_count() -> None:
    calls: list[str] = []

    def log(name: str) -> Steps:
        steps = {"one": lambda: calls.append(name + "1"), "two": lambda: calls.append(name + "2")}
        return Steps(steps, prepare=lambda: calls.append(name + "0"))

    found = interleaved([log("a"), log("b")], repetitions=2, warm_up=1)
    assert calls == ["a0", "a1", "a2", "b0", "b1", "b2"] * 3
    timings = [timing for case in found for timing in case.values()]
    assert all(len(timing.samples) == 2 and timing.minimum <= timing.median for timing in timings)
    assert [list(case) for case in found] == [["one", "two"]] * 2


def test_two_points_are_enough() -> None:
    made = make_gaussians(Points(np.array([[0.0, 0, 0], [1, 0, 0]]), np.full((2, 3), 0.5)), 0)
    made.validate()
