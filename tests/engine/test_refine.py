"""A first frame that goes on being optimised beside the stream: it moves along, mends, waits and arrives."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from bundle import Bundle

from gsstream.core.changes import AddedGaussians, Delta, Layout, RowEdit, Scene
from gsstream.core.errors import ComponentError
from gsstream.core.frame import Arrival, Frame
from gsstream.core.gaussians import Gaussians
from gsstream.encode import Callbacks, Encoder, encoder_for, open_recording
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.fit.densify import DensifyStatistics
from gsstream.engine.frame0 import refine
from gsstream.engine.frame0.axes import nearest_axes
from gsstream.engine.frame0.refine import is_refined, iterations_in, pace_after, track_motion
from gsstream.engine.keys import keyframes
from gsstream.engine.run.encoder import EncodedFrame
from gsstream.engine.run.measure import HeldOut
from gsstream.engine.run.run_frame import SkippedWorkWarning
from gsstream.engine.state.stream_state import Refinement
from gsstream.packet import PlayerState, quantise_key
from gsstream.parts.render.activations import rotation_matrices
from gsstream.recipe.model import Stream

WORLD = "synthetic:frames=6&views=4&width=48&height=32&supersample=1&static=1"
SETTINGS: Mapping[str, Any] = {
    "first_frame.max_iterations": 10, "first_frame.points": "recording", "first_frame.max_points": 250,
    "background": [0, 0, 0], "first_frame.shell": False, "first_frame.few_cameras": False,
    "stream.epochs": 1, "motion": "still",
    "stream.refine_frames": 3, "stream.refine_iterations": 20,
}  # fmt: skip


@cache
def frames(split: str = "train") -> tuple[Frame, ...]:
    with open_recording(WORLD) as source:
        return tuple(source.frame(index, split) for index in range(6))


def encoder(**settings: Any) -> Encoder:
    with open_recording(WORLD) as source:
        return encoder_for("s2gs-edge", source, {**SETTINGS, **settings})


def steps(efforts: tuple[float, ...] = (1,) * 6, **settings: Any) -> list[EncodedFrame]:
    made = encoder(**settings)
    return [made.encode(replace(frame, epoch_scale=e)) for frame, e in zip(frames(), efforts, strict=True)]


@cache
def whole() -> tuple[EncodedFrame, ...]:
    return tuple(steps())


def iterations(made: Any) -> list[int]:
    return [step.metrics.get("refine_iterations", 0) for step in made[1:]]


def test_a_still_scene_is_refined_and_a_key_packet_brings_it() -> None:
    made = whole()
    assert [step.status for step in made] == ["key", "empty", "empty", "key", "empty", "empty"]
    assert iterations(made) == [20, 20, 20, 0, 0]
    assert made[3].metrics["key_reason"] == "refined"
    assert [step.state.refinement is None for step in made] == [False, False, False, True, True, True]
    held_out = HeldOut(encoder().assembly.renderer)
    before, after = (held_out.measure(made[t].state.player, frames("test")[t])["psnr"] for t in (2, 3))
    assert min(after[name] - before[name] for name in before) > 1, "sixty iterations after ten"


def test_frames_that_are_skipped_cost_no_iteration_and_put_the_key_packet_off() -> None:
    made = steps((1, 1, 0, 0, 1, 1))
    assert iterations(made) == [20, 0, 0, 20, 20]
    assert [step.status for step in made] == ["key", "empty", "empty", "empty", "empty", "key"]


def test_a_size_that_no_key_packet_keeps_puts_it_off_and_says_so() -> None:
    made = steps(**{"budget.size": "2KB"})
    assert [step.status for step in made[1:]] == ["empty"] * 5
    assert iterations(made) == [20, 20, 20, 0, 0]
    said = [step.metrics.get("key_postponed", "") for step in made[1:]]
    assert [text.startswith("refined: ") for text in said] == [False, False, True, True, True]


@pytest.mark.parametrize("refined", [0, 2])
def test_what_passes_leave_of_a_budget_of_time_is_for_the_refinement(refined: int) -> None:
    """Two passes are the recipe's; a minute would be enough for all thirty that a budget may buy."""
    settings = {"stream.epochs": 2, "stream.change_threshold": 0, "budget.time": "60s"}
    made = steps(**settings, **{"stream.refine_frames": refined, "stream.refine_iterations": min(refined, 1)})
    passes = [step.metrics["iterations"] / len(frames()[0].cameras) for step in made[1:] if step.status != "key"]
    assert [number <= 2 for number in passes] == [True] * (refined - 1) + [False] * (len(passes) - max(0, refined - 1))


def told(monkeypatch: pytest.MonkeyPatch, efforts: tuple[float, ...]) -> list[str]:
    """What happens in which order: packets that are handed out, and iterations of the refinement."""
    out: list[str] = []
    step = refine.FirstFrameRun.step

    def watched(run: Any, iteration: int) -> float:
        text = f"refined in {run.frame.index}"
        if run.frame.index > 0 and text not in out:
            out.append(text)
        return step(run, iteration)

    monkeypatch.setattr(refine.FirstFrameRun, "step", watched)
    with open_recording(WORLD) as source:
        listeners = Callbacks(packet=lambda packet: out.append(f"{packet.kind.name.lower()} {packet.frame}"))
        made = encoder_for("s2gs-edge", source, SETTINGS, listeners)
    for frame, effort in zip(frames(), efforts, strict=True):
        made.encode(replace(frame, epoch_scale=effort))
    return out


def test_iterations_follow_the_packet_but_those_that_complete_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """The last are needed for the key packet, which is that of their own frame."""
    assert told(monkeypatch, (1,) * 6) == [
        "key 0",
        "empty 1",
        "refined in 1",
        "empty 2",
        "refined in 2",
        "refined in 3",
        "key 3",
        "empty 4",
        "empty 5",
    ]


def test_a_skipped_frame_is_not_taken_for_the_last(monkeypatch: pytest.MonkeyPatch) -> None:
    assert told(monkeypatch, (1, 1, 1, 0, 0, 1)) == [
        "key 0",
        "empty 1",
        "refined in 1",
        "empty 2",
        "refined in 2",
        "empty 3",
        "empty 4",
        "refined in 5",
        "key 5",
    ]


@pytest.mark.parametrize("every", [1, 2])
def test_no_period_of_key_packets_ends_the_refinement(every: int) -> None:
    made = steps(**{"codec.key_interval": every})
    due = {0, *range(3, 6, every)}
    assert [frame for frame, step in enumerate(made) if step.status == "key"] == sorted(due)
    assert made[3].metrics["key_reason"] == "refined"


class Broken:
    """Stands for the loss of a refinement: frames of this world are still, and call it for nothing else."""

    def prepare(self, *_: Any) -> None:
        raise RuntimeError("out of order")

    evaluate = prepare


def broken(sound: Assembly) -> Assembly:
    return replace(sound, renderer=Bundle(sound.part("renderer"), loss=Broken()))


def test_a_refinement_that_fails_leaves_the_encoder_as_it_was() -> None:
    made = encoder()
    sound = made.assembly
    made.encode(frames()[0])
    before = made.state
    made.assembly = broken(sound)
    with pytest.raises(ComponentError, match=r"failed at frame 1, .*out of order"):
        made.encode(frames()[1])
    assert made.state is before
    made.assembly = sound
    sent = [made.encode(frame).packet.data for frame in frames()[1:]]
    assert sent == [step.packet.data for step in whole()[1:]]


def test_a_refinement_that_fails_is_left_out_and_its_iterations_are_made_later() -> None:
    """The packet of the frame is out and sound: a warning says what is missing, and the key packet is put off."""
    made = encoder(**{"stream.on_error": "repeat"})
    sound, lines = made.assembly, []
    for frame in frames():
        made.assembly = broken(sound) if frame.index == 2 else sound
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            lines.append(made.encode(frame).metrics)
        said = [str(one.message) for one in caught if one.category is SkippedWorkWarning]
        assert len(said) == (frame.index == 2), said
    assert [line["status"] for line in lines] == ["key", "empty", "empty", "empty", "key", "empty"]
    assert [line.get("refine_iterations", 0) for line in lines] == [0, 20, 0, 20, 20, 0]
    assert ["error" in line for line in lines] == [False, False, True, False, False, False]


def test_without_it_nothing_is_refined() -> None:
    made = steps(**{"stream.refine_frames": 0, "stream.refine_iterations": 0})
    assert all(step.state.refinement is None and "refine_iterations" not in step.metrics for step in made)
    assert made[0].packet.sizes["means"] == whole()[0].packet.sizes["means"]


def player(gaussians: Gaussians[np.ndarray], counts: list[int], delta: Delta | None = None) -> PlayerState:
    layout = Layout(np.array(counts, np.int32), np.zeros(sum(counts), np.uint8), np.ones(1, np.float32))
    return replace(whole()[0].state.player, scene=Scene(gaussians, layout), delta=delta)


def some(number: int, seed: int) -> Gaussians[np.ndarray]:
    draw = np.random.default_rng(seed)
    shapes = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh0": (1, 3), "shN": (0, 3)}
    return Gaussians(**{k: draw.normal(size=(number, *v)).astype(np.float32) for k, v in shapes.items()})


def refinement(gaussians: Gaussians[np.ndarray], ancestors: list[int]) -> Refinement:
    count = len(ancestors)
    return Refinement(
        gaussians.map(torch.from_numpy),
        torch.zeros(count, dtype=torch.int64),
        torch.tensor(ancestors),
        {},
        DensifyStatistics.zeros(count, torch.device("cpu")),
        iterations=0,
        pace=1,
    )


@pytest.mark.parametrize("seed", range(5))
def test_what_came_of_a_gaussian_keeps_its_place_and_turn_relative_to_it(seed: int) -> None:
    before, after, mine = some(4, seed), some(4, seed + 50), some(6, seed + 99)
    for name in ("means", "quats"):  # row 2 rests
        getattr(after, name)[2] = getattr(before, name)[2]
    ancestors = [0, 0, 1, 2, 3, -1]
    got = track_motion(refinement(mine, ancestors), player(before, [4]), player(after, [4])).gaussians
    was, now = (rotation_matrices(torch.from_numpy(g.quats)).double().numpy() for g in (before, after))
    old, new = (rotation_matrices(torch.from_numpy(np.asarray(g.quats))).double().numpy() for g in (mine, got))
    for row, ancestor in enumerate(ancestors[:5]):
        there = now[ancestor].T @ (got.means[row].numpy() - after.means[ancestor])
        assert there == pytest.approx(was[ancestor].T @ (mine.means[row] - before.means[ancestor]), abs=1e-5)
        assert now[ancestor].T @ new[row] == pytest.approx(was[ancestor].T @ old[row], abs=1e-5)
    for row in (3, 5):
        for name in ("means", "quats"):
            same = getattr(got, name)[row].numpy().tobytes() == getattr(mine, name)[row].tobytes()
            assert same, "what came of a Gaussian that rests, or is gone, rests to the bit"
    for name in ("scales", "opacities", "sh0", "shN"):
        assert getattr(got, name).numpy().tobytes() == getattr(mine, name).tobytes()


def test_rows_that_leave_and_join_are_followed() -> None:
    before, mine, new = some(4, 0), some(4, 1), some(1, 2)
    # Row 1, the last of the first node, leaves, and one is added in its place.
    added = AddedGaussians(new, np.zeros(1, np.int64), np.zeros(1, np.uint8), np.zeros(0, np.int64))
    after = Gaussians(
        **{name: np.concatenate([value[[0]], getattr(new, name), value[[2, 3]]]) for name, value in before.items()}
    )
    after.means[3] += 1.0
    delta = Delta((RowEdit(added, np.array([1], np.int64)),))
    found = track_motion(refinement(mine, [0, 1, 2, 3]), player(before, [2, 2]), player(after, [2, 2], delta))
    assert found.ancestors.tolist() == [0, -1, 2, 3]
    assert found.gaussians.means[3].numpy() == pytest.approx(mine.means[3] + 1.0, abs=1e-5)
    assert torch.equal(found.gaussians.means[:3], torch.from_numpy(mine.means[:3]))


def test_the_key_packet_holds_the_refined_scene() -> None:
    made = encoder(**{"codec.key_rd_lambda": 0})
    for frame in frames()[:3]:
        made.encode(frame)
    before = made.state.refinement
    found: list[Refinement] = []
    original = keyframes.refined_key_step

    def watched(parts: Any, state: Any, *rest: Any, **named: Any) -> EncodedFrame:
        found.append(state.refinement)
        return original(parts, state, *rest, **named)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(keyframes, "refined_key_step", watched)
        step = made.encode(frames()[3])
    assert found[0].iterations == before.iterations + 20 == 60
    ours = quantise_key(nearest_axes(found[0].gaussians).map(lambda t: t.numpy()))
    theirs = step.state.player.gaussians
    assert np.array_equal(
        *(np.unique(np.column_stack([v.reshape(len(v), -1) for _, v in g.items()]), axis=0) for g in (ours, theirs))
    )
    assert step.state.player.meta.extra["shown"] == 3


@pytest.mark.parametrize("seed", range(20))
def test_the_refinement_of_a_capture_takes_the_time_that_the_stream_leaves(seed: int) -> None:
    """Over any run of frames that wait, are dropped or are in time: within the recipe, and none while one waits."""
    draw = np.random.default_rng(seed)
    stream = Stream(refine_frames=int(draw.integers(1, 30)), refine_iterations=int(draw.integers(1, 200)))
    most, now = stream.refine_iterations, refinement(some(2, 0), [0, 1])
    for _ in range(300):
        behind, skipped = draw.random() < 0.3, draw.random() < 0.1
        frame = replace(frames()[1], epoch_scale=float(not skipped), arrival=Arrival(None, waiting=int(behind)))
        made, pace = iterations_in(stream, now, frame), pace_after(stream, now.pace, frame)
        assert (made > 0) == (not behind and not skipped and not is_refined(stream, now))
        assert made <= now.pace
        assert (pace < now.pace or pace == 1) if behind or skipped else (pace > now.pace or pace == most)
        now = replace(now, iterations=now.iterations + made, pace=pace)
        assert now.iterations <= stream.refine_frames * most
    left = stream.refine_frames * most - now.iterations
    assert iterations_in(stream, now, frames()[1]) == min(left, most), "a finished recording leaves all time"
