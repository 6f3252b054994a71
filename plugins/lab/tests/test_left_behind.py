"""Ways on the screen and Gaussians left behind, on a scene whose truth is known."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from gsstream_lab.left_behind import LeftBehind

from gsstream.engine.run.displacement import displacement_pixels, screen_displacement
from gsstream.input.recordings.open import open_source

WORLD = "synthetic:scene=stop&event=90&frames=20&views=5&width=96&height=72&supersample=1&shadows=0"
AT = 12


@pytest.fixture(scope="module")
def source():
    return open_source(WORLD)


def player(means: np.ndarray, opacity: float = 3.0) -> SimpleNamespace:
    gaussians = SimpleNamespace(means=means.astype(np.float32), opacities=np.full(len(means), opacity, np.float32))
    return SimpleNamespace(gaussians=gaussians, delta=None, before=None, scene=SimpleNamespace(displacement=None))


def inner_ball(source, frame: int) -> np.ndarray:
    """40 points well inside the ball at a frame, so that their pixels are the ball's."""
    way = np.random.default_rng(0).normal(size=(40, 3))
    return source.object_positions(frame)["ball"] + 0.09 * way / np.linalg.norm(way, axis=1, keepdims=True)


def test_ways_are_those_of_the_projections(source) -> None:
    before, after = inner_ball(source, 0), inner_ball(source, 2)
    rig, expected = source.info.train, []
    for view in range(len(rig)):
        uv = []
        for points in (before, after):
            local = (rig.viewmats[view] @ np.c_[points, np.ones(len(points))].T)[:3]
            pixel = rig.Ks[view] @ local
            uv.append((pixel[:2] / pixel[2]).T)
        inside = [((p >= 0) & (p < (96, 72))).all(1) for p in uv]
        expected.append(np.where(inside[0] & inside[1], np.linalg.norm(uv[1] - uv[0], axis=1), np.nan))
    np.testing.assert_allclose(screen_displacement(before, after, rig), np.nanmean(expected, axis=0), rtol=1e-6)
    behind = np.array([[50.0, 0, 1]])
    assert np.isnan(screen_displacement(behind, behind, rig)).all(), "no camera sees it"
    moved = SimpleNamespace(rows=np.arange(40), translation=(after - before).astype(np.float32))
    state = player(after)
    state.scene.displacement = moved
    found = displacement_pixels(state, rig)
    assert found["median"] == pytest.approx(np.median(np.nanmean(expected, axis=0)), rel=1e-3)
    assert found["max"] >= found["median"] > 1
    state.scene.displacement = None
    assert displacement_pixels(state, rig) == {"median": 0.0, "max": 0.0}


def test_who_goes_along_who_stays_and_who_is_lost_on_the_way(source) -> None:
    """40 rows of the ball, and 40 of the wall behind everything that nothing passes."""
    wall = np.column_stack([np.full(40, -2.9), np.linspace(-0.3, 0.3, 40), np.full(40, 0.5)])
    start = np.concatenate([inner_ball(source, 0), wall])
    for name, went, outside, unmoved in (("all", 40, 0, 0), ("half", 20, 0, 20), ("lost", 30, 10, 0)):
        now = start.copy()
        now[:went] = inner_ball(source, AT)[:went]
        if name == "lost":
            now[went:40] = inner_ball(source, AT // 2)[went:]  # where the ball has been, and is not any more
        found = LeftBehind()
        assert found.after(player(start), source.frame(0), True) == {"body": 0, "outside": 0, "unmoved": 0}
        counted = found.after(player(now), source.frame(AT), False)
        assert counted["body"] == 40, name
        assert (counted["outside"], counted["unmoved"]) == (outside, unmoved), name


def test_rows_are_followed_through_births_and_deaths_and_faint_ones_are_not_counted(source) -> None:
    start = inner_ball(source, 0)
    found = LeftBehind()
    found.after(player(start), source.frame(0), True)
    # Three leave, two are added in front: 37 of the first are there still, in other rows.
    now = np.concatenate([np.zeros((2, 3)), inner_ball(source, AT)[3:]])
    state = player(now)

    class Born:
        nodes = np.array([0, 0])

        def __len__(self) -> int:
            return 2

    state.delta = SimpleNamespace(has_row_edit=True, added=Born(), removed=np.array([0, 1, 2]))
    # Row by row its own node, so that added Gaussians of node 0 stand first.
    state.before = SimpleNamespace(node_of=np.arange(len(start)))
    assert found.after(state, source.frame(AT), False) == {"body": 37, "outside": 0, "unmoved": 0}
    faint = LeftBehind()
    faint.after(player(start, opacity=-3.0), source.frame(0), True)
    assert faint.after(player(start), source.frame(AT), False)["body"] == 0
