"""Anchors against nearest neighbours by hand; what they inherit; bodies that are found again; rows that come and go."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from gsstream_recon.anchors import AnchorLevels, Level, bound, inherited
from gsstream_recon.motion import AnchorMotion

from gsstream.api import Delta, Layout, Rng, Scene, apply_motion
from gsstream.blocks import pixel_size
from gsstream.core.changes import Displacement
from gsstream.testing import MethodUnderTest
from gsstream.testing import motion as bodies
from tests.scenes import RIG, SquaredDistances, scene_at

RNG = np.random.default_rng(0)
Settings = AnchorMotion.Config
ANCHOR = Settings(measure="anchor", per_anchor=5, pixels=0.2, step=0.01, rotation_step=0.001)


def due(before: AnchorLevels | None, frame: int, number: int, settings: Settings, rng: Rng) -> AnchorLevels:
    """The anchors of a frame that changes no row."""
    return AnchorMotion(settings).follow(before, frame, Layout.flat(number, 1.0), Delta(), rng)


def fitted(scene: Scene, aims: np.ndarray, rows: np.ndarray, settings: Settings, epochs: int = 30, before=None):
    """(the frame, the scene after the motion that was found)."""
    work = SquaredDistances(scene, aims, rows)
    part = AnchorMotion(settings.model_copy(update={"epochs": epochs}))
    for motion in part.propose(scene, work, Rng(0), before):
        scene = apply_motion(scene, motion)[0]
    return work, scene


def test_anchors_are_drawn_by_level_and_both_ends_could_draw_the_same() -> None:
    settings = Settings(per_anchor=24, levels=3, every=2)
    first = due(None, 5, 2160, settings, Rng(7))
    assert [len(rows) for rows in first.rows] == [10, 30, 90]
    assert set(first.rows[0]) < set(first.rows[1]) < set(first.rows[2]), "a finer level adds to the coarser ones"
    again = due(None, 5, 2160, settings, Rng(7))
    assert [rows.tobytes() for rows in first.rows] == [rows.tobytes() for rows in again.rows]
    assert due(first, 6, 2160, settings, Rng(7)) is first
    assert due(first, 7, 2160, settings, Rng(7)).drawn == 7
    assert not np.array_equal(due(first, 7, 2160, settings, Rng(7)).rows[2], first.rows[2])
    lost = AnchorLevels(5, (np.zeros(0, np.int64), *first.rows[1:]))
    assert due(lost, 6, 2160, settings, Rng(7)).drawn == 6, "a level without an anchor cannot be followed"
    assert [len(rows) for rows in due(None, 1, 4, settings, Rng(7)).rows] == [1, 1, 1]


def test_anchors_lie_where_gaussians_are_dense() -> None:
    means = np.concatenate([RNG.normal(0, 0.01, (900, 3)), RNG.uniform(5, 9, (100, 3))])
    rows = due(None, 1, 1000, Settings(per_anchor=10), Rng(0)).rows[2]
    assert (means[rows][:, 0] < 1).sum() == pytest.approx(90, abs=8)


def test_each_cell_follows_the_nearest_anchor_of_each_level() -> None:
    means, centres = RNG.normal(size=(50, 3)).astype(np.float32), RNG.normal(size=(20, 3))
    anchors = due(None, 1, 50, Settings(per_anchor=4), Rng(0))
    for level, rows in zip(bound(centres, means, anchors), anchors.rows, strict=True):
        distance = np.linalg.norm(centres[:, None] - means[rows][None], axis=2)
        np.testing.assert_allclose(level.at[level.of], means[rows][distance.argmin(1)])
        assert set(level.of) == set(range(len(level.at))), "only anchors that some cell follows are kept"


def test_levels_say_the_past_together_and_new_anchors_inherit_it() -> None:
    past = RNG.normal(size=(6, 6))
    old = [Level(np.zeros((1, 3)), np.zeros(6, np.int64)), Level(np.eye(3)[:2] * 1.0, np.array([0, 0, 0, 1, 1, 1]))]
    coarse, fine = inherited(past, old, old, 3)
    np.testing.assert_allclose(coarse[0], past.mean(0))
    np.testing.assert_allclose(coarse[0] + fine, [past[:3].mean(0), past[3:].mean(0)])
    new = [old[0], Level(np.array([[0.75, 0.25, 0.0], [1.0, 0, 0]]), old[1].of)]
    _, drawn = inherited(past, old, new, 2)
    np.testing.assert_allclose(drawn[0], (3 * fine[0] + fine[1]) / 4, rtol=0.02)
    np.testing.assert_allclose(drawn[1], fine[0], atol=0.01, err_msg="where an old anchor lay, as it moved")
    np.testing.assert_allclose(inherited(past, old, new, 9)[1], drawn, err_msg="there are no more than two")


def test_the_weight_of_motion_keeps_what_the_images_say_nothing_about() -> None:
    """The images show the Gaussians where momentum moves them, so only the weight of the penalty moves them back."""
    means = RNG.normal((0, 0, 3), 0.05, (60, 3))
    shift = np.tile(np.float32([0.05, 0, 0]), (60, 1))
    scene = scene_at(means, Displacement(np.arange(60), shift, np.zeros_like(shift)))
    before = due(None, 0, 60, ANCHOR, Rng(0))
    moved = {}
    for weight in (0.0, 1.0):
        settings = ANCHOR.model_copy(update={"l1_weight": weight, "lr": 0.02})
        _, after = fitted(scene, means + 0.6 * shift, np.arange(60), settings, 1, before=before)
        moved[weight] = np.abs(after.gaussians.means - means).mean()
    assert moved[1.0] < 0.95 * moved[0.0]


def test_rounded_motions_are_shown_while_they_are_fitted_and_sent_as_they_are() -> None:
    """Cells hold one Gaussian each here, so none turns about a centre; shifts are the sums of whole steps."""
    means = RNG.uniform((-0.3, -0.3, 2.7), (0.3, 0.3, 3.3), (80, 3))
    settings = ANCHOR.model_copy(update={"step": 0.5, "rotation_step": 1.0, "pixels": 0.01, "lr": 0.2, "rounded": True})
    scene = scene_at(means)
    work, after = fitted(scene, means + 0.1 * means[:, :1], np.arange(80), settings)
    step = 0.5 * pixel_size(scene.gaussians.means, RIG)
    for seen in (*work.seen, after.gaussians.means):
        whole = (seen - scene.gaussians.means) / step
        np.testing.assert_allclose(whole, np.rint(whole), atol=1e-3)
    assert not (work.seen[1] != scene.gaussians.means).any(), "after a step of 0.2 pixels every motion is still zero"
    assert len(np.unique(np.rint((after.gaussians.means - scene.gaussians.means)[:, 0] / step))) > 1


def test_anchors_stay_with_their_gaussians_and_a_resumed_run_finds_them() -> None:
    method = MethodUnderTest("recon")
    motion = AnchorMotion(Settings(measure="anchor", per_anchor=4, every=2, step=0.001))
    copies = type(method.assembly.part("growth"))
    growth = copies(copies.Config(gradient=1e-7, rounds=1, most=7, prune_opacity=0.0))
    method.assembly = replace(method.assembly, motion=motion, growth=growth)
    states = [step.state for step in method.steps]
    assert [state.motion_memory and state.motion_memory.drawn for state in states] == [None, 1, 1]
    before, state = states[1:]
    kept = np.delete(np.arange(len(before.player.gaussians)), state.player.delta.removed)
    assert len(state.player.delta.removed) == 7
    for old, new in zip(before.motion_memory.rows, state.motion_memory.rows, strict=True):
        here = old[np.isin(old, kept)]
        opacities = before.player.gaussians.opacities[here], state.player.gaussians.opacities[new]
        assert opacities[0].tobytes() == opacities[1].tobytes()
    memory, rng = None, method.encoder().rng
    for player in (state.player for state in states[1:]):
        memory = motion.follow(memory, player.frame, player.before, player.delta, rng)
    assert [rows.tolist() for rows in memory.rows] == [rows.tolist() for rows in states[-1].motion_memory.rows]


def test_where_frames_were_skipped_a_fit_begins_with_the_way_of_all_of_them() -> None:
    part, last = AnchorMotion(), bodies.shifted((1.5, 0.8, 0), (-1.0, 0.7, 0))
    seen = bodies.invisible(bodies.two_bodies(), last)
    skipped = replace(seen, displacement=None, heading=seen.displacement)
    assert bodies.momentum_error(part, skipped, last) <= bodies.TOLERANCE
