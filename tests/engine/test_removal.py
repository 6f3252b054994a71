"""Which Gaussians of frame 0 the images would not miss: the estimate against removing them, extremes, whole runs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from test_encoder import TINY, WORLD, frames

from gsstream.core.gaussians import Gaussians
from gsstream.core.rng import Rng
from gsstream.encode import encoder_for, open_recording
from gsstream.engine.frame0.hutchinson import TrainingViews
from gsstream.engine.frame0.prune import prune_by_error, removal_errors, retained_rows
from gsstream.packet import decode_packet
from gsstream.parts.render.base import Renderer
from gsstream.parts.render.exposure import Exposure
from gsstream.parts.render.reference import ReferenceRenderer

BLACK = (0.0, 0.0, 0.0)
GROWING = {"first_frame.max_iterations": 60}


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return ReferenceRenderer()


def fitted(**settings: Any) -> Gaussians[np.ndarray]:
    """Frame 0 of the small world."""
    with open_recording(WORLD) as source:
        encoder = encoder_for("s2gs-edge", source, {**TINY, "background": list(BLACK), **settings})
        packet = encoder.encode(frames()[0]).packet
    return decode_packet(None, packet.data).gaussians


def images(renderer: Renderer, scene: Gaussians[torch.Tensor], exposure: Exposure | None = None) -> torch.Tensor:
    cameras = frames()[0].cameras
    drawn = [renderer.render(scene, cameras, view, BLACK).image for view in range(len(cameras))]
    return torch.stack([image if exposure is None else exposure[v].apply(image) for v, image in enumerate(drawn)])


@pytest.mark.parametrize("exposed", [False, True])
def test_the_estimate_is_what_leaving_one_out_changes(renderer: Renderer, exposed: bool) -> None:
    """Another way to the same number: draw the scene without it. Opaque ones are among them."""
    scene = fitted(**{"first_frame.prune_error": 0}).map(torch.from_numpy)
    opacities = scene.opacities.clone()
    opacities[::3] = 30.0
    scene = replace(scene, opacities=opacities)
    torch.manual_seed(0)
    exposure = Exposure(torch.eye(3) + 0.2 * torch.randn(3, 3, 3), 0.1 * torch.randn(3, 3)) if exposed else None
    drawn = [
        removal_errors(TrainingViews(renderer, frames()[0], exposure, BLACK), scene, Rng(seed).stream("a", 0))
        for seed in range(12)
    ]
    found = torch.stack([errors for errors, _ in drawn]).mean(0)
    whole = images(renderer, scene, exposure)
    for row in (*range(0, len(scene), max(1, len(scene) // 12)), int(found.argmax()), int(found.argmin())):
        rest = torch.tensor([other for other in range(len(scene)) if other != row])
        exact = float((images(renderer, scene.rows(rest), exposure) - whole).double().square().sum())
        assert float(found[row]) == pytest.approx(exact, rel=0.6, abs=1e-4)
    truth = torch.from_numpy(np.stack(list(frames()[0].images)))
    assert drawn[0][1] == pytest.approx(float((whole - truth).square().mean()), rel=1e-3)


def test_the_reference_and_the_cpu_renderer_agree(renderer: Renderer) -> None:
    scene = fitted().map(torch.from_numpy)
    with open_recording(WORLD) as source:
        native = encoder_for("s2gs-edge", source, TINY).parts.renderer
    one, other = (
        removal_errors(TrainingViews(part, frames()[0], None, BLACK), scene, Rng(3).stream("a", 0))[0]
        for part in (renderer, native)
    )
    assert torch.allclose(one, other, rtol=0.05, atol=1e-4)


def test_what_nobody_sees_goes_and_what_is_seen_alone_stays(renderer: Renderer) -> None:
    scene = fitted().map(torch.from_numpy)
    far = scene.rows(torch.zeros(1, dtype=torch.int64))
    far = replace(far, means=far.means + 1000.0)
    both = Gaussians(**{name: torch.cat([getattr(scene, name), getattr(far, name)]) for name, _ in scene.items()})
    errors, error = removal_errors(TrainingViews(renderer, frames()[0], None, BLACK), both, Rng(0).stream("a", 0))
    assert float(errors[-1]) == 0.0
    kept = retained_rows(errors, 0.1 * error)
    assert len(scene) not in kept.tolist()
    assert len(kept) > 0


def test_rows_without_an_error_remain_and_order_is_kept() -> None:
    assert retained_rows(torch.tensor([0.0, 2.0, 0.0, 3.0]), 0.0).tolist() == [1, 3]
    assert retained_rows(torch.tensor([3.0, 1.0, 2.0]), 1.5).tolist() == [0, 2]
    assert retained_rows(torch.zeros(3), 0.0).tolist() == [0, 1, 2]
    assert retained_rows(torch.ones(2), 5.0).tolist() == [0, 1]
    assert retained_rows(torch.zeros(0), 1.0).tolist() == []


def test_a_run_has_fewer_gaussians_that_show_nearly_the_same(renderer: Renderer) -> None:
    every, fewer = (fitted(**GROWING, **{"first_frame.prune_error": least}) for least in (0.0, 10.0))
    assert 0 < len(fewer) < 0.9 * len(every)
    truth = torch.from_numpy(np.stack(list(frames()[0].images)))
    errors = [
        float((images(renderer, scene.map(torch.from_numpy)) - truth).square().mean()) for scene in (every, fewer)
    ]
    assert errors[1] < 1.3 * errors[0]


def test_of_equal_gaussians_none_is_missed_and_yet_not_all_go(renderer: Renderer) -> None:
    """Ten of each, which together are as opaque: each alone may go, all together may not."""
    scene = fitted(**{"first_frame.prune_error": 0}).map(torch.from_numpy)
    left = (1 - scene.opacities.double().sigmoid().clamp(max=0.99)) ** 0.1
    thin = replace(scene, opacities=((1 - left) / left).log().float())
    many = thin.rows(torch.arange(len(scene)).repeat_interleave(10))
    truth = torch.from_numpy(np.stack(list(frames()[0].images)))

    def error(rows: torch.Tensor) -> float:
        return float((images(renderer, many.rows(rows)) - truth).square().mean())

    def drawn() -> torch.Generator:
        return Rng(0).stream("a", 0)

    whole = error(torch.arange(len(many)))
    errors, _ = removal_errors(TrainingViews(renderer, frames()[0], None, BLACK), many, drawn())
    least = float(errors.max()) / whole / 2
    assert error(retained_rows(errors, least * whole)) > 1.5 * whole, "otherwise this says nothing"
    kept = prune_by_error(TrainingViews(renderer, frames()[0], None, BLACK), many, drawn(), least)
    assert error(kept) <= 1.25 * whole * (1 + 1e-4)
    assert torch.equal(kept, kept.sort().values)
