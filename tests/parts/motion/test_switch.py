"""Which groups a move helps: the answer has the sign and the size of what two renders say."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from gsstream.core.changes import Displacement, Groups, Layout, Scene
from gsstream.core.changes.motion import GroupTransforms, predict_transforms, transform_groups
from gsstream.core.gaussians import Gaussians
from gsstream.core.hierarchy import Hierarchy
from gsstream.core.log import FrameLog
from gsstream.core.rng import Rng
from gsstream.engine.state.stream_state import StreamState
from gsstream.engine.step.active.change import detect_changed_tiles
from gsstream.engine.step.context import EngineContext
from gsstream.packet import PlayerState
from gsstream.parts.motion.constant_velocity import Coasting, loss_change, rotating_views
from gsstream.parts.motion.groups import pixel_size
from gsstream.parts.render.wrt import WrtRows
from gsstream.testing.method_driver import MethodUnderTest
from gsstream.testing.working import fit_fixture

#: Axis * tan(angle / 2): a third of a radian, mostly about the axis that the cameras look along.
TURN = np.float32([0.05, 0.05, 0.15])


@cache
def body(turns: bool = False) -> tuple[Scene, GroupTransforms]:
    """Three soft Gaussians some pixels apart, each a group.

    They are balls and were displaced by a pixel to the side in the last frame; or they are long, stand still and turn.
    """
    case = fit_fixture()
    pixel = pixel_size(case.scene.gaussians.means, case.work.cameras)
    means = np.median(case.scene.gaussians.means, 0) + 9 * pixel * np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    gaussians = Gaussians(
        means.astype(np.float32), np.tile(np.float32([1, 0, 0, 0]), (3, 1)),
        np.log(pixel * np.tile(np.float32([4, 1, 1] if turns else [1.5] * 3), (3, 1))), np.full(3, 3, np.float32),
        np.float32([[[1, 0, 0]], [[0, 1, 0]], [[0, 0, 1]]]), np.zeros((3, 0, 3), np.float32),
    )  # fmt: skip
    layout = Layout(np.ones(3, np.int32), np.zeros(3, np.uint8), np.float32([1]))
    shift = np.tile(np.float32([pixel, 0, 0]), (3, 1))
    groups = Groups(float(np.float32(pixel)), 1, np.arange(3, dtype=np.int32), 3)
    scene = Scene(gaussians, layout, Displacement(np.arange(3), shift, np.zeros_like(shift)), groups)
    moves = predict_transforms(scene, groups, np.ones(3, np.uint8), predicted=True)
    if turns:
        rotation = np.tile(TURN, (3, 1)).astype(moves.rotation.dtype)
        moves = moves._replace(translation=np.zeros_like(moves.translation), rotation=rotation)
    return scene, moves


def frame_in_which(share: float, turns: bool = False) -> EngineContext:
    """Return the frame that shows this share of the last displacement once more, or of the turn."""
    scene, moves = body(turns)
    method, case = MethodUnderTest("dense"), fit_fixture()
    part = moves._replace(translation=moves.translation * share, rotation=moves.rotation * share)
    there = transform_groups(scene.gaussians, part)
    cameras = case.work.cameras
    stands, shows = (
        np.stack([case.work.shown(gaussians.map(torch.from_numpy), view).numpy() for view in range(len(cameras))])
        for gaussians in (scene.gaussians, there)
    )
    previous = replace(case.work._previous, images=stands.clip(0, 1))
    frame = replace(previous, index=3, images=shows.clip(0, 1), cameras=cameras)
    change, forest = (
        detect_changed_tiles(previous, frame, 6.0),
        Hierarchy(torch.arange(3), torch.arange(3), torch.zeros(3).long()),
    )
    player = PlayerState(2, scene, None, key_rows=3)  # type: ignore[arg-type]
    return EngineContext(method.parts, StreamState(player, forest, previous), frame, FrameLog(), change)


def loss(work: EngineContext, gaussians, view: int) -> float:  # type: ignore[no-untyped-def]
    work.narrow(torch.arange(len(gaussians)))
    return float(work.loss_and_grad(view, WrtRows(gaussians.map(torch.from_numpy))).loss)


@pytest.mark.parametrize("turns", [False, True])
@pytest.mark.parametrize(("share", "sign"), [(1.0, -1), (0.4, 1), (-1.0, 1)])
def test_the_switch_says_what_two_renders_say(share: float, sign: int, turns: bool) -> None:
    """At 0.4 the frame lies just before half-way: a gradient that was taken nearer to the start has the other sign."""
    scene, moves = body(turns)
    work = frame_in_which(share, turns)
    views = range(len(work.cameras))
    expected = sum(
        loss(work, transform_groups(scene.gaussians, moves), view) - loss(work, scene.gaussians, view) for view in views
    )
    found = loss_change(frame_in_which(share, turns), moves, views)
    assert np.sign(expected) == sign
    assert np.sign(found).tolist() == [sign] * 3
    # The loss is no parabola, and one group hides another: the size is right within a factor of two, or of three where
    # the loss has its edge near the middle.
    assert 0.5 < found.sum() / expected < (2 if abs(share) == 1 else 3)


@pytest.mark.parametrize("share", [1.0, 0.0, -1.0])
def test_coasting_goes_on_only_where_that_explains_the_images(share: float) -> None:
    """What stops or turns back is not carried on: neither half of the groups, nor for one frame."""
    scene, _ = body()
    every = Coasting(Coasting.Config(votes=0.0, share=0.0, asked=1.0))
    found = every.propose(scene, frame_in_which(share), Rng(0))
    moving = sum(int(motion.moving.sum()) for motion in found)
    assert moving == (3 if share == 1.0 else 0)
    blind = Coasting(Coasting.Config(votes=0.0, share=0.0, asked=0.0))
    went = sum(int(motion.moving.sum()) for motion in blind.propose(scene, frame_in_which(share), Rng(0)))
    assert went == (3 if share else 0), "nobody is asked: whatever lies in what changed goes on"


def test_views_take_turns() -> None:
    for number, share in ((11, 0.5), (3, 0.01), (27, 1.0), (1, 0.5)):
        turns = [rotating_views(number, share, frame) for frame in range(number)]
        count = max(1, round(share * number))
        assert all(len(views) == count and 0 <= views.min() <= views.max() < number for views in turns)
        assert np.unique(np.concatenate(turns)).tolist() == list(range(number))
