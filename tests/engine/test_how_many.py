"""How many Gaussians frame 0 keeps: the bound by pixels, what views show of each, and which ones go."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from test_encoder import TINY, WORLD, frames

from gsstream.core.gaussians import SH0, Gaussians
from gsstream.encode import encoder_for, open_recording
from gsstream.engine.frame0.how_many import most_gaussians, shown, worth_keeping
from gsstream.packet import decode_packet
from gsstream.recipe.model import FirstFrame
from gsstream.render.base import Renderer
from gsstream.render.reference import ReferenceRenderer

BLACK = (0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return ReferenceRenderer()


def fitted(**settings: Any) -> Gaussians[np.ndarray]:
    """Frame 0 of the small world."""
    with open_recording(WORLD) as source:
        packet = encoder_for("s2gs-edge", source, {**TINY, **settings}).encode(frames()[0]).packet
    return decode_packet(None, packet.data).gaussians


def test_what_the_views_show_is_what_a_change_of_colour_changes_in_them(renderer: Renderer) -> None:
    """Another way to the same number: draw the scene twice, with one Gaussian a little brighter the second time."""
    scene, cameras = fitted().map(torch.from_numpy), frames()[0].cameras
    found = shown(renderer, scene, cameras)
    grey = replace(scene, sh0=torch.zeros_like(scene.sh0), shN=scene.shN[:, :0])
    for row in (0, 7, int(found.argmax()), int(found.argmin())):
        bright = replace(grey, sh0=grey.sh0.clone())
        bright.sh0[row] = 0.5
        pixels = [
            float((renderer.render(bright, cameras, view, BLACK).image - drawn).sum())
            for view, drawn in enumerate(renderer.render(grey, cameras, v, BLACK).image for v in range(len(cameras)))
        ]
        assert float(found[row]) == pytest.approx(max(pixels) / 3 / (0.5 * SH0), rel=1e-3, abs=2e-3)


def test_in_one_view_all_weights_together_are_its_alpha(renderer: Renderer) -> None:
    scene, cameras = fitted().map(torch.from_numpy), frames()[0].cameras.select([1])
    alpha = renderer.render(scene, cameras, 0, BLACK).alpha
    assert float(shown(renderer, scene, cameras).sum()) == pytest.approx(float(alpha.sum()), rel=1e-4)


def test_a_black_gaussian_hides_what_is_behind_it_and_counts(renderer: Renderer) -> None:
    """Its colour is cut off at 0, where the image has no slope: as it is coloured, it would seem to show nothing."""
    scene, cameras = fitted().map(torch.from_numpy), frames()[0].cameras
    black = replace(scene, sh0=torch.full_like(scene.sh0, -5.0))
    assert torch.equal(shown(renderer, black, cameras), shown(renderer, scene, cameras))
    assert float(shown(renderer, black, cameras).max()) > 1


@given(st.integers(0, 1000), st.floats(0, 0.99))
def test_the_least_shown_go_as_far_as_the_share_allows(seed: int, share: float) -> None:
    pixels = torch.from_numpy(10 ** np.random.default_rng(seed).uniform(-6, 2, 50)).float()
    rows = worth_keeping(pixels, share)
    assert torch.equal(rows, rows.sort().values), "rows stay in order"
    gone = torch.ones(50, dtype=torch.bool)
    gone[rows] = False
    lost, whole = float(pixels[gone].double().sum()), float(pixels.double().sum())
    assert lost <= share * whole * (1 + 1e-9)
    assert float(pixels[rows].min()) >= float(pixels[gone].max() if bool(gone.any()) else 0.0)
    assert lost + float(pixels[rows].min()) > share * whole * (1 - 1e-9), "one more would be too many"


def test_what_no_view_shows_goes_first_and_nothing_fails_at_the_extremes() -> None:
    assert worth_keeping(torch.tensor([0.0, 2.0, 0.0, 3.0]), 0.0).tolist() == [1, 3]
    assert worth_keeping(torch.tensor([1.0, 1.0]), 0.5).tolist() == [1]
    assert worth_keeping(torch.zeros(0), 0.5).tolist() == []
    assert worth_keeping(torch.zeros(3), 0.1).tolist() == [0, 1, 2], "no view shows anything: nothing says what to drop"


def test_the_bound_by_pixels_is_below_the_cap_or_the_cap() -> None:
    frame = frames()[0]
    pixels = 3 * 32 * 24
    assert most_gaussians(FirstFrame(), frame) == 60_000
    assert most_gaussians(FirstFrame(pixels_per_gaussian=10), frame) == pixels // 10
    assert most_gaussians(FirstFrame(pixels_per_gaussian=10, max_gaussians=50), frame) == 50
    assert most_gaussians(FirstFrame(pixels_per_gaussian=1e9), frame) == 1


def test_a_run_keeps_to_both() -> None:
    growing = {"first_frame.max_iterations": 60, "first_frame.densify_from": 10, "first_frame.densify_every": 5}
    plain = {**growing, "first_frame.densify_gradient": 1e-6}
    free, bound = fitted(**plain), fitted(**plain, **{"first_frame.pixels_per_gaussian": 8.0})
    assert len(bound) <= 3 * 32 * 24 // 8 < len(free)
    pruned = fitted(**plain, **{"first_frame.prune_share": 0.05})
    assert 0 < len(pruned) < len(free)
