"""Motions beside the rest of a frame: where they are looked for, in which unit, how often, how many bytes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from gsstream.core.cameras import Cameras
from gsstream.core.picture_size import enlargement, far_weight
from gsstream.core.rng import Rng
from gsstream.engine.fit.photometric import FrameImages
from gsstream.engine.step.compared import Found
from gsstream.engine.step.context import EngineContext
from gsstream.engine.step.motion import Moved, propose_motion
from gsstream.engine.step.tools import RunTools
from gsstream.input.recordings.open import open_source
from gsstream.method.budget import FrameBudget
from gsstream.packet.changes.motion import encode_motions
from gsstream.parts.backend.change import Change, find_change
from gsstream.parts.motion.groups import pixel_size
from gsstream.parts.motion.none import Still
from gsstream.parts.motion.rigid import Rigid
from gsstream.parts.render.target import ViewTarget
from gsstream.parts.render.wrt import WrtRows
from gsstream.testing.method_driver import SOURCE, FitFixture, MethodUnderTest, fit_fixture, method_with


def near_by_hand(tiles: np.ndarray) -> np.ndarray:
    """Tiles with a changed one at most one row and one column away."""
    out = np.zeros_like(tiles)
    for view, row, column in np.argwhere(tiles):
        out[view, max(0, row - 1) : row + 2, max(0, column - 1) : column + 2] = True
    return out


@pytest.mark.parametrize("share", [0.0, 0.05, 0.3, 1.0])
def test_near_is_what_changed_and_what_lies_beside_it_in_the_same_view(share: float) -> None:
    tiles = np.random.default_rng(3).random((3, 5, 7)) < share
    near = Change(torch.from_numpy(tiles), 80, 112).dilated
    assert near.dtype == torch.bool
    assert np.array_equal(near.numpy(), near_by_hand(tiles))


def differentiated(
    case: FitFixture, tiles: torch.Tensor | None, looked_at: Literal["all", "changed"]
) -> tuple[float, torch.Tensor]:
    """Loss of view 0 and its gradient by all means when these tiles changed."""
    work = case.work
    work._change = None if tiles is None else Change(tiles, work.cameras.height, work.cameras.width)
    found = work.loss_and_grad(0, WrtRows(work.gaussians), looked_at)
    return float(found.loss), found.grad.means


def test_changed_tiles_alone_leave_out_all_else() -> None:
    case = fit_fixture()
    assert case.work._change is not None
    tiles = torch.zeros_like(case.work._change.tiles)
    _, gradient = differentiated(case, tiles, "changed")
    assert float(gradient.abs().max()) == 0, "nothing changed, so nothing is compared"
    everything, every_gradient = differentiated(case, torch.ones_like(tiles), "changed")
    without, gradient_without = differentiated(case, tiles, "all")
    assert everything == pytest.approx(without), "where all changed, all is compared"
    torch.testing.assert_close(every_gradient, gradient_without)
    assert float(every_gradient.abs().max()) > 0
    unknown, gradient_unknown = differentiated(case, None, "changed")
    assert unknown == pytest.approx(without), "where change is not looked for, all is compared"
    torch.testing.assert_close(gradient_unknown, gradient_without)


def noted(case: FitFixture) -> list[str]:
    """The tiles that each call is to look at, noted as the calls are made."""
    asked: list[str] = []
    body = case.work.loss_and_grad

    def call(view: int, wrt: Any, tiles: str = "all") -> Any:
        asked.append(tiles)
        return body(view, wrt, tiles)  # type: ignore[arg-type]

    case.work.loss_and_grad = call  # type: ignore[method-assign,assignment]
    return asked


@pytest.mark.parametrize(("effort", "calls"), [(1.0, 6), (0.5, 3), (0.2, 1), (0.01, 1)])
def test_a_hurried_frame_fits_motion_in_its_share_of_the_passes(effort: float, calls: int) -> None:
    case = fit_fixture()
    case.work._frame = replace(case.work._frame, epoch_scale=effort)
    made = noted(case)
    Rigid(Rigid.Config(epochs=2)).propose(case.scene, case.work, case.rng)
    assert len(made) == calls, "two passes over three cameras, or a share of them"


def test_motions_look_near_the_change() -> None:
    case = fit_fixture()
    asked = noted(case)
    Rigid(Rigid.Config()).propose(case.scene, case.work, case.rng)
    assert set(asked) == {"changed"}


@pytest.mark.parametrize("far", [1.0, 0.25, 0.0])
def test_the_less_far_tiles_weigh_the_less_of_them_is_compared(far: float) -> None:
    work = fit_fixture().work
    tiles = torch.zeros(len(work.cameras), 5, 7, dtype=torch.bool)
    tiles[:, 2, 3] = True
    work._change = Change(tiles, 5 * 16, 7 * 16)
    weights = work.changed_target(0, far).tile_weights
    assert (weights is None) == (far == 1.0)
    if weights is not None:
        near = work._change.dilated[0]
        assert bool((weights[near] == 1).all())
        assert bool((weights[~near] == far).all())
        assert 0 < int(near.sum()) < near.numel()
    everywhere = work.everywhere().changed_target(0, far)
    assert everywhere.tile_weights is None, "a residual of every row is compared everywhere"


@pytest.mark.parametrize("width", [320, 1352])
def test_the_residual_of_a_large_picture_is_compared_with_less_of_what_is_far(
    width: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The width is only said to the rule: the pictures stay small."""
    asked: list[float] = []
    target = EngineContext.changed_target

    def watched(self: EngineContext, view: int, far: float = 0.0) -> ViewTarget:
        asked.append(far)
        return target(self, view, far)

    monkeypatch.setattr(EngineContext, "changed_target", watched)
    monkeypatch.setattr("gsstream.engine.step.frame_step.far_weight", lambda _: far_weight(width))
    method = MethodUnderTest("s2gs-edge")
    method.assembly = replace(method.assembly, motion=Still())  # a motion is compared with what changed alone
    source = open_source(SOURCE)
    method.step(method.begin(source.frame(0)).state, source.frame(1))
    assert set(asked) == {far_weight(width)}
    assert far_weight(1352) < far_weight(320)


#: Pictures this small hardly say where a group has gone: what holds it back must be weak.
MOVES = Rigid(Rigid.Config(votes=0, share=0, hold=0.1))


def within(max_bytes: int | None) -> Moved:
    parts = method_with("motion", MOVES).assembly
    state = method_with("motion", MOVES).chain()[1].state
    frame = replace(open_source(SOURCE).frame(2), cameras=state.previous.cameras)
    budget = FrameBudget(epochs=1, change_threshold=6.0, rd_lambda=0.0, max_bytes=max_bytes)
    change = find_change(*(list(map(torch.from_numpy, each.images)) for each in (state.previous, frame)), 6.0)
    tools = RunTools(parts, Rng(0), Mock(), Mock(), budget=budget)
    before = FrameImages(state.previous.images, torch.device("cpu"))
    return propose_motion(parts, state, frame, Found(change, before), tools)


@pytest.mark.parametrize("spare", [0, -1])
def test_motions_take_half_of_a_frame_at_most(spare: int) -> None:
    free = within(None)
    assert sum(int(motion.moving.sum()) for motion in free.motions) > 0
    size = sum(len(data) for _, data in encode_motions(free.motions))
    held = within(2 * size + spare)
    assert len(held.motions) == (len(free.motions) if spare == 0 else 0)
    before = method_with("motion", MOVES).chain()[1].state.player.gaussians.means
    went = (held.scene.gaussians.means != before).any()
    assert bool(went) == (spare == 0), "what is not sent is not moved either"


def test_it_is_the_median_over_cameras_and_gaussians_of_distance_over_focal_length() -> None:
    rng = np.random.default_rng(3)
    means = rng.normal(size=(101, 3)).astype(np.float32)
    viewmats = np.tile(np.eye(4), (4, 1, 1))
    viewmats[:, :3, 3] = rng.normal(size=(4, 3)) * 5
    Ks = np.tile(np.eye(3), (4, 1, 1))
    Ks[:, 0, 0] = Ks[:, 1, 1] = [50.0, 60.0, 70.0, 80.0]
    cameras = Cameras(tuple("abcd"), viewmats, Ks, 32, 24)
    widths = [np.linalg.norm(means - at, axis=1) / K[0, 0] for at, K in zip(cameras.centers, cameras.Ks, strict=True)]
    # To the bit: a step of motions is made of it, and a stream's bytes with it.
    assert pixel_size(means, cameras) == float(np.median(np.concatenate(widths)))


@pytest.mark.parametrize("times", [1, 2, 4.225])
def test_lengths_in_pixels_mean_the_same_in_the_scene_at_every_size_of_picture(times: float) -> None:
    """Sides of groups and longest steps are some pixels times both, so a recipe fits the same recording at any size."""
    means = np.random.default_rng(3).normal(size=(50, 3)).astype(np.float32)
    viewmats = np.tile(np.eye(4), (2, 1, 1))
    viewmats[:, 2, 3] = 7.0
    K = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
    small = Cameras(("a", "b"), viewmats, np.stack([K, K]), 320, 240)
    large = small.scaled(round(320 * times), round(240 * times))
    length = pixel_size(means, large) * enlargement(large.width)
    assert length == pytest.approx(pixel_size(means, small), rel=1e-12)
