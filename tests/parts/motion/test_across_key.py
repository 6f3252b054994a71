"""How a scene was moving before a key packet: said of the rows of the key packet, and where a fit begins."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gsstream.core.changes import Displacement, Layout, Scene, apply_delta
from gsstream.core.changes.delta import Delta
from gsstream.core.changes.motion import groups_for
from gsstream.parts.motion.across_key import displacement_across_key
from gsstream.parts.motion.rigid import Rigid
from gsstream.testing import motion as bodies
from gsstream.testing.cases import scene as blobs

CELL, BINS = 0.5, 2


def moved_scene(number: int, seed: int = 0, *, displaced: np.ndarray | None = None) -> Scene:
    """A scene whose rows were displaced by the last frame, each by its own vector unless they are given."""
    rng = np.random.default_rng(seed)
    means = torch.from_numpy(rng.normal(0, 1, (number, 3)).astype(np.float32))
    scene = Scene(blobs(means, seed=seed).map(torch.Tensor.numpy), Layout.flat(number, 1.0))
    translation = rng.normal(0, 0.1, (number, 3)).astype(np.float32) if displaced is None else displaced
    turn = rng.normal(0, 0.05, (number, 3)).astype(np.float32)
    scene = replace(scene, groups=groups_for(scene, CELL, BINS))
    return replace(scene, displacement=Displacement(np.arange(number), translation, turn))


def key_of(scene: Scene, order: np.ndarray) -> Scene:
    """The scene of a frame later, as a key packet in another order of rows has it: nothing of what was before."""
    moved = scene.displacement
    means = scene.gaussians.means.copy()
    means[moved.rows] += moved.translation
    return Scene(replace(scene.gaussians, means=means).rows(order), Layout.flat(len(order), 1.0))


@pytest.mark.parametrize("number", [1, 7, 200])
def test_every_row_has_the_mean_of_what_is_bound_for_its_cell_and_shade(number: int) -> None:
    """The reference goes row by row."""
    before = moved_scene(number)
    order = np.random.default_rng(5).permutation(number)
    key = key_of(before, order)
    found = displacement_across_key(before, key)
    assert found is not None
    assert found.rows.tolist() == list(range(number))
    group = groups_for(key, CELL, BINS).group_of
    for row in range(number):
        mates = order[group == group[row]]
        for got, given in (
            (found.translation, before.displacement.translation),
            (found.rotation, before.displacement.rotation),
        ):
            assert got[row] == pytest.approx(given[mates].astype(np.float64).mean(0), rel=1e-5, abs=1e-7)


def test_rows_that_none_is_bound_for_are_not_listed() -> None:
    before = moved_scene(60)
    still = replace(before, displacement=Displacement(*(value[:20] for value in _fields(before.displacement))))
    key = key_of(still, np.arange(60))
    found = displacement_across_key(still, key)
    group = groups_for(key, CELL, BINS).group_of
    assert found is not None
    assert found.rows.tolist() == [row for row in range(60) if group[row] in set(group[:20].tolist())]
    assert 20 <= len(found.rows) < 60, "some are listed for their neighbours, others not at all"


@pytest.mark.parametrize("without", ["displacement", "groups"])
def test_a_scene_that_did_not_move_hands_nothing_on(without: str) -> None:
    before = moved_scene(5)
    assert displacement_across_key(replace(before, **{without: None}), key_of(before, np.arange(5))) is None


def test_what_was_skipped_before_a_key_packet_counts() -> None:
    before = moved_scene(30)
    longer = before.displacement.times(3.0)
    skipped = replace(before, displacement=None, heading=longer)
    found = displacement_across_key(skipped, key_of(replace(before, displacement=longer), np.arange(30)))
    assert found is not None
    assert len(found.rows) == 30


def test_places_far_outside_the_grid_are_places_too() -> None:
    """Cells beyond the grid are one cell, here as where groups are formed."""
    far = np.full((4, 3), 1e30, np.float32)
    found = displacement_across_key(moved_scene(4, displaced=far), key_of(moved_scene(4, displaced=far), np.arange(4)))
    assert found is not None
    assert np.isfinite(found.translation).all()


def test_a_fast_body_is_found_after_a_key_packet_where_it_is_found_before_one() -> None:
    """Bodies of six pixels that move by nine a frame: too far for a fit from rest, not for one that knows of them."""
    part, shift = Rigid(), bodies.shifted((9.0, 0.0, 0.0), (0.0, -8.0, 0.0))
    before = bodies.two_bodies()
    groups = groups_for(before, 0.6, BINS)
    moving = replace(before, groups=groups, displacement=Displacement(np.arange(len(shift)), shift, 0 * shift))
    order = np.concatenate([np.random.default_rng(1).permutation(40), 40 + np.random.default_rng(2).permutation(40)])
    key = key_of(moving, order)
    wanted = key.gaussians.means + shift[order]

    def pixels_off(memory: Displacement | None) -> float:
        found = bodies.after_motion(part, key, shift[order], memory=memory)
        return float(np.abs((found - wanted).reshape(2, 40, 3).mean(1)).max()) * bodies.PIXELS

    assert pixels_off(part.across_key(moving, key)) < 0.5
    assert pixels_off(None) > 2.0, "the case asks for what the part keeps"


def test_a_fast_body_is_found_after_frames_that_were_skipped() -> None:
    """It moved by three pixels a frame and two frames were skipped; the one after them moves by three pixels again."""
    part, step = Rigid(), bodies.shifted((3.0, 0.0, 0.0), (0.0, -3.0, 0.0))
    before = bodies.two_bodies()
    scene = replace(before, groups=groups_for(before, 0.6, BINS))

    def pixels_off(shift: np.ndarray, displaced: np.ndarray | None, heading: np.ndarray | None) -> float:
        last, ahead = (
            None if way is None else Displacement(np.arange(80), way, 0 * way) for way in (displaced, heading)
        )
        found = bodies.after_motion(part, replace(scene, displacement=last, heading=ahead), shift)
        return float(np.abs((found - before.gaussians.means - shift).reshape(2, 40, 3).mean(1)).max()) * bodies.PIXELS

    assert pixels_off(3 * step, None, 3 * step) < 0.5
    assert pixels_off(3 * step, None, None) > 2.0, "the case asks for where bodies are heading"
    assert pixels_off(step, 3 * step, step) < 0.5


def test_a_player_that_begins_with_the_key_packet_decodes_the_same_motion() -> None:
    """What is kept decides where the fit begins, and nothing that a player would have to know."""
    part, shift = Rigid(), bodies.shifted((3.0, 0.0, 0.0), (0.0, 2.0, 0.0))
    key = bodies.two_bodies()
    kept = Displacement(np.arange(len(shift)), shift, 0 * shift)
    _, work, rng = bodies._work(key, shift, everywhere=False)
    motions = part.propose(key, work, rng, kept)
    assert motions
    after = apply_delta(key, Delta(motions)).gaussians.means
    assert np.abs(after - key.gaussians.means - shift).max() * bodies.PIXELS < 0.5


def _fields(displacement: Displacement) -> tuple[np.ndarray, ...]:
    return displacement.rows, displacement.translation, displacement.rotation


def test_where_frames_were_skipped_a_fit_begins_with_the_way_of_all_of_them() -> None:
    part, last = Rigid(), bodies.shifted((1.5, 0.8, 0), (-1.0, 0.7, 0))
    seen = bodies.invisible(bodies.two_bodies(), last)
    skipped = replace(seen, displacement=None, heading=seen.displacement)
    assert bodies.momentum_error(part, skipped, last) <= bodies.TOLERANCE
