"""The shell and the colour behind everything in a stream: chosen at frame 0, and left alone by every later frame."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from gsstream.core.changes import RowEdit, Scene, apply_light
from gsstream.core.frame import Frame
from gsstream.core.log import FrameLog
from gsstream.core.rng import Rng
from gsstream.encode import Encoder, encoder_for, open_recording
from gsstream.engine.step.context import EngineContext
from gsstream.input.seeds.shell import SEEDS, find_shell, in_shell
from gsstream.packet import PlayerState
from gsstream.parts.growth.base import Growth
from gsstream.parts.growth.copying import high_gradient_rows
from gsstream.parts.render.work import FitContext

WORLD = "synthetic:frames=4&views=4&width=48&height=36&supersample=1&motion=3"
TINY: dict[str, Any] = {
    "first_frame.max_iterations": 12,
    "first_frame.max_points": 300,
    "first_frame.prune_error": 0,
    "stream.epochs": 2,
}
#: All of the scene may change, and every group may move.
EVERYTHING: dict[str, Any] = {"stream.change_threshold": 0, "motion": "rigid"}


def brighter(frame: Frame) -> Frame:
    """The same instant under a light that grows from frame to frame, so that all pixels change."""
    lit = np.clip(frame.images * 0.5 + 0.1 * frame.index, 0, 1)
    return replace(frame, images=lit.astype(np.float32))


def encoded(method: str, settings: dict[str, Any], number: int = 4, **parts: Any) -> list[PlayerState]:
    with open_recording(WORLD) as source:
        encoder = encoder_for(method, source, {**TINY, **settings}, **parts)
        return [encoder.encode(brighter(source.frame(index))).state.player for index in range(number)]


def shell_of(player: PlayerState) -> np.ndarray:
    return in_shell(player.gaussians.means, player.gaussians.scales, find_shell(player.meta.train))


def rows_of(player: PlayerState, rows: np.ndarray) -> set[bytes]:
    table = np.column_stack([value[rows].reshape(int(rows.sum()), -1) for _, value in player.gaussians.items()])
    return {row.tobytes() for row in table}


@pytest.mark.parametrize(
    ("method", "settings"),
    [("s2gs-edge", EVERYTHING), ("s2gs-edge", {}), ("dense", EVERYTHING), ("dense", {"codec.key_interval": 2})],
)
def test_the_shell_stays_as_it_is_in_every_frame(method: str, settings: dict[str, Any]) -> None:
    states = encoded(method, settings)
    still = shell_of(states[0])
    assert still.sum() >= SEEDS - 5, "nothing has been pruned yet"
    for before, after in itertools.pairwise(states):
        if after.delta is None:  # a key packet: its grid rounds every value once more, and orders the rows anew
            assert np.isclose(shell_of(after).sum(), still.sum(), atol=2)
        else:
            shell, light = shell_of(before), after.delta.light
            lit = before if light is None else replace(before, scene=apply_light(before.scene, light))
            assert rows_of(after, shell) == rows_of(lit, shell), after.frame
            assert (before.gaussians.sh0 != after.gaussians.sh0).any(), "the rest of the scene does change"


@pytest.mark.parametrize("method", ["hicom", "recon", "stream3dgs", "comgs-l"])
def test_motions_of_cells_and_of_fields_leave_the_shell_where_it_is(method: str) -> None:
    """A cell of the scene may reach into the shell."""
    settings = {key: value for key, value in TINY.items() if key != "stream.epochs"}
    settings |= {"stream.change_threshold": 0, "motion.epochs": 4, "growth": "none"}
    with open_recording(WORLD) as source:
        encoder = encoder_for(method, source, settings)
        states = [encoder.encode(brighter(source.frame(index))).state.player for index in range(3)]
    still = shell_of(states[0])
    for before, after in itertools.pairwise(states):
        moved = (before.gaussians.means != after.gaussians.means).any(1)
        assert moved.any()
        assert not moved[still].any(), f"frame {after.frame} moves {int(moved[still].sum())} rows of the shell"


def test_a_scene_without_a_shell_has_no_still_rows() -> None:
    bare = encoded("dense", {"first_frame.shell": False}, number=2)
    with_it = encoded("dense", {}, number=1)
    assert len(with_it[0].gaussians) == len(bare[0].gaussians) + SEEDS
    before, after = bare
    assert (before.gaussians.sh0 != after.gaussians.sh0).any(axis=(1, 2)).mean() > 0.5


class Reaper(Growth):
    """Lets every other Gaussian go."""

    source = "a test"

    def propose(self, after: Scene, work: FitContext, rng: Rng) -> RowEdit | None:
        return RowEdit(removed=np.arange(0, len(after.gaussians), 2)) if work.index == 1 else None


def test_growth_removes_and_copies_nothing_of_the_shell() -> None:
    first, second = encoded("dense", {}, number=2, growth=Reaper())
    still = shell_of(first)
    assert still[::2].any(), "the part does propose some of it"
    assert len(second.gaussians) == len(first.gaussians) - int((~still[::2]).sum())
    assert rows_of(second, shell_of(second)) == rows_of(first, still)


def test_places_to_copy_are_none_of_the_shell() -> None:
    with open_recording(WORLD) as source:
        encoder = encoder_for("dense", source, TINY)
        state = encoder.encode(source.frame(0)).state
        frame = encoder.with_near_plane(source.frame(2))
        work = EngineContext(encoder.assembly, state, frame, FrameLog())
        still = work.shell_rows
        assert bool(still.any())
        places = high_gradient_rows(work, -1.0)  # every Gaussian that any gradient reaches
        assert not bool(still[places].any())
        assert len(places) == int((~still).sum())
        assert torch.equal(work.changed_rows(0.0), ~still)


def background(settings: dict[str, Any], method: str = "dense", first: PlayerState | None = None) -> Encoder:
    with open_recording(WORLD) as source:
        encoder = encoder_for(method, source, {**TINY, **settings})
        if first is not None:
            encoder = Encoder(encoder.assembly, source.info, first_frame=first)
        encoder.encode(source.frame(0))
    return encoder


def test_the_colour_behind_everything_is_the_mean_of_frame_0_and_stays() -> None:
    with open_recording(WORLD) as source:
        mean = brighter(source.frame(0)).images.reshape(-1, 3).astype(np.float64).mean(0)
    states = encoded("dense", {"codec.key_interval": 2})
    assert [state.delta is None for state in states] == [True, False, True, False]
    for state in states:  # the pictures grow brighter, and a later key packet tells the colour again
        assert state.meta.background == pytest.approx(mean.tolist(), abs=1e-6)
        assert state.meta.background == states[0].meta.background


def test_a_recipe_may_name_the_colour_and_the_paper_has_black() -> None:
    assert background({"background": [0.25, 0.5, 1]}).state.player.meta.background == (0.25, 0.5, 1)
    assert background({"first_frame.sh_degree": 0}, "s2gs-paper").state.player.meta.background == (0, 0, 0)


def test_a_scene_that_is_taken_over_keeps_the_colour_that_it_was_fitted_on() -> None:
    first = background({"background": [0.25, 0.5, 1]}).state.player
    taken = background({}, first=first)
    assert taken.state.player.meta.background == (0.25, 0.5, 1)
    assert taken.assembly.recipe.background == "auto", "the recipe of the stream is what was asked for"
