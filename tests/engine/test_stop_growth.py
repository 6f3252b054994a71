"""Growth of frame 0 that ends by itself: the rule, who judges, and that nothing is fitted to what judges."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gsstream.core.frame import Frame
from gsstream.core.rng import Rng
from gsstream.encode import Encoder, Listeners, encoder_for, open_recording
from gsstream.engine.assembly.assemble import assemble
from gsstream.engine.fit.exposure import Exposure, ExposureFit
from gsstream.engine.frame0.begin import seeded
from gsstream.engine.frame0.how_many import most_seeds
from gsstream.engine.frame0.left_out import DOUBLED, PATIENCE, Growth, judged, left_out_tiles
from gsstream.engine.frame0.optimise import FirstFrameRun, initial_gaussians
from gsstream.method.base import Step
from gsstream.plugins.catalog import load_catalog
from gsstream.recipe.load import resolve_recipe
from gsstream.recipe.model import FirstFrame

WORLD = "synthetic:frames=1&views=16&width=96&height=72&supersample=1"
ASKED: Mapping[str, Any] = {"first_frame.stop_growth": "left-out"}
GROWING: Mapping[str, Any] = {
    "first_frame.points": "recording", "first_frame.max_points": 200, "first_frame.fill_points": 0,
    "first_frame.max_iterations": 900, "first_frame.densify_from": 140, "first_frame.densify_every": 100,
    "first_frame.densify_gradient": 6e-4,
}  # fmt: skip
JUDGED = FirstFrame(stop_growth="left-out")


@cache
def world(noise: float = 0.0) -> Frame:
    with open_recording(WORLD) as source:
        frame = source.frame(0)
    drawn = np.random.default_rng(0).normal(0, noise / 255, frame.images.shape)
    return replace(frame, images=np.clip(frame.images + drawn, 0, 1).astype(np.float32))


@dataclass(frozen=True)
class Grown:
    """A frame 0, and the number of Gaussians after each of its iterations."""

    step: Step[Any]
    counts: tuple[int, ...]


@cache
def grown(noise: float, threads: int = 1) -> Grown:
    """Frame 0 of the world, with noise of so many 8-bit levels on its images."""
    counts: list[int] = []
    listeners = Listeners(progress=lambda iteration, iterations, loss, count: counts.append(count))
    with open_recording(WORLD) as source:
        made: Encoder = encoder_for("s2gs-edge", source, {**GROWING, **ASKED}, listeners)
    return Grown(made.encode(world(noise)), tuple(counts))


# The rule.


@given(st.integers(100, 10_000), st.floats(10, 30), st.lists(st.floats(1.01, 2), min_size=1, max_size=30))
def test_growth_never_ends_while_it_gains_enough(first: int, psnr: float, factors: list[float]) -> None:
    growth, count = Growth().look(first, psnr), first
    for factor in factors:
        more = math.ceil(count * factor)
        psnr, count = psnr + 1.01 * DOUBLED * math.log2(more / count) + 1e-9, more
        growth = growth.look(count, psnr)
        assert growth.pays
        assert growth.misses == 0


@given(st.integers(100, 10_000), st.floats(-5, 60), st.floats(-1, 0), st.floats(1, 2))
def test_growth_ends_on_a_flat_or_falling_series_exactly_when_patience_does(
    count: int, psnr: float, slope: float, factor: float
) -> None:
    growth = Growth().look(count, psnr)
    for look in range(1, PATIENCE + 1):
        assert growth.pays
        growth = growth.look(int(count * factor**look), psnr + slope * look)
    assert not growth.pays


def test_a_gain_is_measured_from_the_last_look_that_paid() -> None:
    """One bad look is forgiven, but many small gains that together are too small for the Gaussians are not."""
    growth = Growth().look(1000, 20.0).look(1200, 19.0)
    assert (growth.gaussians, growth.psnr, growth.misses) == (1000, 20.0, 1)
    assert growth.look(1400, 20.5) == Growth(1400, 20.5, 0)
    slow = Growth().look(1000, 20.0)
    for count in (1500, 2250):
        slow = slow.look(count, slow.psnr + 0.5 * DOUBLED * math.log2(1.5))
    assert not slow.pays


def test_a_look_that_is_no_number_does_not_pay() -> None:
    growth = Growth().look(100, 20.0).look(110, math.nan).look(120, math.nan)
    assert not growth.pays
    assert Growth().look(100, math.inf).look(110, math.inf).misses == 1


# Who judges.


@given(st.integers(4, 9), st.integers(1, 70), st.integers(1, 70), st.integers(0, 5))
def test_every_image_leaves_out_an_eighth_of_its_tiles_and_at_least_one(
    views: int, height: int, width: int, seed: int
) -> None:
    frame = world()
    rig = frame.cameras.select([0] * views)
    frame = replace(frame, images=np.zeros((views, height, width, 3), np.float32), cameras=rig)
    tiles = left_out_tiles(JUDGED, frame, Rng(seed))
    assert tiles is not None
    assert tiles.shape == (views, math.ceil(height / 16), math.ceil(width / 16))
    assert tiles.sum((1, 2)).tolist() == [max(1, tiles[0].numel() // 8)] * views
    assert torch.equal(tiles, left_out_tiles(JUDGED, frame, Rng(seed)))


def test_nothing_is_left_out_unasked_and_three_cameras_say_that_they_are_too_few() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert left_out_tiles(FirstFrame(), world(), Rng(0)) is None
    few = replace(world(), images=world().images[:3], cameras=world().cameras.select([0, 1, 2]))
    with pytest.warns(UserWarning, match="at least 4 training cameras.* got 3; Gaussians grow as with 'never'"):
        assert left_out_tiles(JUDGED, few, Rng(0)) is None


@pytest.mark.parametrize("with_exposure", [False, True])
def test_what_tiles_say_is_the_mean_psnr_of_each(with_exposure: bool) -> None:
    """Independent reference: whole images, pixel by pixel. 72 rows are four and a half tiles."""
    run = running(world(), with_exposure)
    frame, scene, tiles = run.frame, run.gaussians().map(torch.Tensor.detach), run.left_out
    assert tiles is not None
    exposure = Exposure.identity(16)
    exposure = Exposure(0.9 * exposure.matrix, exposure.offset + 0.02)
    psnr = []
    for view, row, column in tiles.nonzero().tolist():
        shown = run.renderer.render(scene, frame.cameras, view, (0.1, 0.2, 0.3)).image
        shown = (0.9 * shown + 0.02 if with_exposure else shown).clamp(0, 1).double().numpy()
        part = np.s_[16 * row : 16 * row + 16, 16 * column : 16 * column + 16]
        psnr.append(-10 * np.log10(np.square(shown[part] - frame.images[view][part]).mean()))
    found = judged(run.renderer, scene, frame, tiles, (0.1, 0.2, 0.3), exposure if with_exposure else None)
    assert found == pytest.approx(np.mean(psnr), abs=1e-3)


def test_a_tile_without_any_error_counts_as_one_that_is_rounded_to_8_bits() -> None:
    run = running(world(), False)
    frame = replace(run.frame, images=np.zeros_like(run.frame.images))
    scene = run.gaussians().map(torch.Tensor.detach)
    hidden = replace(scene, opacities=torch.full_like(scene.opacities, -20.0))
    assert run.left_out is not None
    found = judged(run.renderer, hidden, frame, run.left_out, (0.0, 0.0, 0.0), None)
    assert found == pytest.approx(10 * math.log10(12 * 255**2))


# The fit.


def running(frame: Frame, exposure: bool) -> FirstFrameRun:
    """Frame 0 at its start; without SSIM, whose windows see across the rim of a tile."""
    settings = {**GROWING, **ASKED, "first_frame.exposure": exposure, "loss.dssim": 0}
    pairs = [("--set", f"{key}={str(value).lower()}") for key, value in settings.items()]
    catalog = load_catalog()
    parts = assemble(resolve_recipe("s2gs-edge", catalog.recipe_path, overrides=pairs), catalog)
    with open_recording(WORLD) as source:
        points = source.points()
    assert points is not None
    anchors = seeded(parts, points, frame)
    start = initial_gaussians(anchors, parts.recipe.first_frame)
    run = FirstFrameRun(start, anchors.levels, frame, parts, Rng(0).stream("test", 0), 20)
    run.exposure = ExposureFit.start(len(frame.cameras)) if exposure else None
    run.left_out = left_out_tiles(parts.recipe.first_frame, frame, Rng(0))
    return run


@pytest.mark.parametrize("exposure", [False, True])
def test_a_tile_that_judges_gives_no_gradient_while_gaussians_grow_and_does_afterwards(exposure: bool) -> None:
    """The same run on images with something else in these tiles: the same to the last bit, until growth has ended."""
    true = running(world(), exposure)
    assert true.left_out is not None
    hidden = true.left_out.repeat_interleave(16, 1).repeat_interleave(16, 2)[:, :72, :96].numpy()
    other = running(replace(world(), images=np.where(hidden[..., None], 1 - world().images, world().images)), exposure)
    until = int(0.6 * true.iterations)
    for iteration in range(1, until + 1):
        true.step(iteration)
        other.step(iteration)
        assert (true.left_out is None) == (iteration == until)
    same_scene(true, other)
    for run in (true, other):
        for iteration in range(until + 1, until + 9):
            run.step(iteration)
    with pytest.raises(AssertionError):
        same_scene(true, other)


def same_scene(one: FirstFrameRun, other: FirstFrameRun) -> None:
    for (name, ours), (_, theirs) in zip(one.gaussians().items(), other.gaussians().items(), strict=True):
        assert torch.equal(ours, theirs), name
    if one.exposure is not None and other.exposure is not None:
        assert torch.equal(one.exposure.exposure.matrix, other.exposure.exposure.matrix)


def test_noise_ends_growth_early_and_without_it_growth_goes_on() -> None:
    """Four looks fit into the iterations; without noise the number of Gaussians still grows by half after the last."""
    noisy, clean = grown(40.0), grown(0.0)
    assert clean.step.metrics["growth_ended"] is None
    assert clean.counts[-1] > 1.4 * clean.counts[450]
    assert noisy.step.metrics["growth_ended"] in (400, 500)
    assert noisy.step.metrics["num_gaussians"] < clean.step.metrics["num_gaussians"] / 2


def test_after_its_end_births_only_replace_what_is_pruned() -> None:
    noisy = grown(40.0)
    ended = noisy.step.metrics["growth_ended"]
    assert max(noisy.counts[ended:]) <= noisy.counts[ended - 2]


def test_growth_ends_alike_for_a_seed_and_any_number_of_threads() -> None:
    threads = pytest.importorskip("gsstream_cpu_render.threads")
    before = threads.num_threads()
    try:
        threads.set_num_threads(3)
        again = grown(40.0, threads=3)
    finally:
        threads.set_num_threads(before)
    assert again is not grown(40.0)
    assert again.step.packet.data == grown(40.0).step.packet.data


def test_a_judged_frame_0_starts_from_no_more_gaussians_than_points() -> None:
    assert most_seeds(FirstFrame(), world()) == 60_000
    assert most_seeds(JUDGED, world()) == 12_000
    assert most_seeds(FirstFrame(stop_growth="left-out", max_points=50), world()) == 50
    assert most_seeds(FirstFrame(stop_growth="left-out", max_gaussians=500), world()) == 500
