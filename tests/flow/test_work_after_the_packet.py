"""A frame's packet does not wait for the refinement of an early frame 0, and a kill meanwhile costs no bit."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from early_densify import densifying
from forked import gsstream

from gsstream.engine.frame0 import refine
from gsstream.engine.run import session
from gsstream.packet import StreamReader
from tests.flow import capture
from tests.flow.flow_runs import arguments, demo_copy, encode, metrics

#: Six iterations in each of the frames 1 to 3; Gaussians are added and pruned in the first two of them.
REFINED: dict[str, Any] = {
    "stream__refine_frames": 3,
    "stream__refine_iterations": 6,
}
QUICK = {"first_frame__max_iterations": 8, "first_frame__prune_error": 0, "stream__epochs": 1, "scale": 0.5}

#: Gaussians are added early in another process, as in the tests that run in this one.
EARLY = """
from gsstream.engine.fit import constants
constants.DENSIFY_FROM, constants.DENSIFY_EVERY = 5, 4
"""
#: The process is killed, as from outside, at an iteration of a frame's refinement.
DYING = """
import os, signal
from gsstream.engine.frame0 import refine

step = refine.FirstFrameRun.step

def dying(run, iteration):
    if (run.frame.index, iteration) == {}:
        os.kill(os.getpid(), signal.SIGKILL)
    return step(run, iteration)

refine.FirstFrameRun.step = dying
"""


def written(stream: Path) -> list[int]:
    """Frames whose packets a stream holds."""
    with StreamReader(stream) as reader:
        return [entry.frame for entry in reader.frames]


@pytest.fixture(autouse=True, scope="module")
def early_growth() -> Iterator[None]:
    with densifying(5, 4):
        yield


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    out = tmp_path_factory.mktemp("undisturbed")
    once = encode(out, method="s2gs-edge", **REFINED)
    lines = metrics(out)
    assert [line["status"] for line in lines] == ["key", "delta", "delta", "key", "delta", "delta"]
    assert [line.get("refine_iterations", 0) for line in lines] == [0, 6, 6, 6, 0, 0]
    assert ["refine" in line["seconds"] for line in lines] == [False, True, True, True, False, False]
    return once


@pytest.mark.parametrize("goes_on_from", ["lines", "packets"])
@pytest.mark.parametrize(
    ("frame", "iteration", "packets"), [(1, 1, 2), (2, 9, 3), (3, 15, 3)], ids=["first", "middle", "last"]
)
def test_a_run_killed_in_the_refinement_resumes_to_the_same_bytes(
    tmp_path: Path, undisturbed: bytes, frame: int, iteration: int, packets: int, goes_on_from: str
) -> None:
    """Its packet is out and its line is not written; in the last frame the packet brings what the iterations make."""
    command = arguments(tmp_path, method="s2gs-edge", **REFINED)
    killed = gsstream(command, first=EARLY + DYING.format((frame, iteration)))
    assert killed.returncode == -9
    assert written(tmp_path / "stream.gss") == list(range(packets))
    assert [line["frame"] for line in metrics(tmp_path)] == list(range(frame))
    assert undisturbed.startswith((tmp_path / "stream.gss").read_bytes())
    if goes_on_from == "packets":  # then the iterations of all frames that the stream holds are made again
        (tmp_path / "metrics.jsonl").unlink()
    done = gsstream([*command, "--resume"], first=EARLY)
    assert done.returncode == 0, done.stderr
    told = f"frame {frame} of the stream is made again" in done.stderr
    assert told == (goes_on_from == "lines" and packets > frame)
    assert (tmp_path / "stream.gss").read_bytes() == undisturbed
    assert [line["frame"] for line in metrics(tmp_path)] == list(range(6))


def growing(tmp_path: Path, *there: int, frames: int) -> tuple[Path, Path]:
    """A finished recording, and a folder that has its calibration and some of its frames."""
    finished, live = demo_copy(tmp_path / "scene", frames=frames), tmp_path / "live"
    capture.begin(finished, live)
    capture.come(finished, live, *there)
    return finished, live


def during_refinements(monkeypatch: pytest.MonkeyPatch, happens: Callable[[int], object]) -> None:
    """Call ``happens`` with the index of every frame that moves or goes on with the refinement, before it does."""
    advanced = refine.advance_refinement

    def busy(*args: Any, **named: Any) -> Any:
        happens(named["frame"].index)
        return advanced(*args, **named)

    monkeypatch.setattr(refine, "advance_refinement", busy)


def test_no_latency_contains_its_own_refinement_but_the_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By a clock on which every refinement takes a thousand seconds; the packet is in the file when it begins."""
    clock, held = [0.0], []
    finished, live = growing(tmp_path, 0, 1, frames=5)

    def slow(frame: int) -> None:
        clock[0] += 1000.0
        held.append(written(tmp_path / "run" / "stream.gss")[-1])
        capture.come(finished, live, frame + 1)

    during_refinements(monkeypatch, slow)
    shifted = SimpleNamespace(time=lambda: time.time() + clock[0], perf_counter=time.perf_counter)
    monkeypatch.setattr(session, "time", shifted)
    encode(tmp_path / "run", "--frames", "5", source=f"watch:{live}?ready=rename", **{**QUICK, **REFINED})
    assert held == [1, 2, 2], "frame 3 brings the refined scene: its packet follows its iterations"
    lines = metrics(tmp_path / "run")
    assert [int(line["live"]["latency_seconds"] // 1000) for line in lines] == [0, 0, 1, 3, 3]
    assert [line.get("refine_iterations", 0) for line in lines] == [0, 6, 6, 6, 0]


def test_frames_that_come_during_the_refinement_wait_as_the_policy_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A packet that is out does not make the encoder idle: four frames come while frame 1 is refined.

    After them the refinement goes on at a lower pace; and a run that is resumed anywhere goes on to the same bytes.
    """
    finished, live = growing(tmp_path, 0, 1, frames=6)
    during_refinements(monkeypatch, lambda frame: capture.come(finished, live, *(range(2, 6) if frame == 1 else ())))
    command = {"source": f"watch:{live}?behind=drop&queue=1&ready=rename", **QUICK, **REFINED}
    encode(tmp_path / "run", "--frames", "6", **command)
    lines = metrics(tmp_path / "run")
    assert [line["live"]["policy"] for line in lines] == [None, None, "dropped", "dropped", "dropped", None]
    assert [line.get("refine_iterations") for line in lines] == [None, 6, 0, 0, 0, 1]


@pytest.mark.parametrize("done", [2, 5])  # in between, fewer frames wait than when it was decided to drop them
def test_a_run_that_was_refined_among_dropped_frames_resumes_to_the_same_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, done: int
) -> None:
    finished, live = growing(tmp_path, 0, 1, frames=6)
    during_refinements(monkeypatch, lambda frame: capture.come(finished, live, *(range(2, 6) if frame == 1 else ())))
    command = {"source": f"watch:{live}?behind=drop&queue=1&ready=rename", **QUICK}
    command |= {"stream__refine_frames": 2, "stream__refine_iterations": 1}
    once = encode(tmp_path / "run", "--frames", "6", **command)
    lines = metrics(tmp_path / "run")
    assert [line.get("refine_iterations") for line in lines] == [None, 1, 0, 0, 0, 1]
    assert lines[5]["key_reason"] == "refined"
    kept = (tmp_path / "run" / "metrics.jsonl").read_text().splitlines(keepends=True)[:done]
    (tmp_path / "run" / "metrics.jsonl").write_text("".join(kept))
    assert encode(tmp_path / "run", "--frames", "6", "--resume", **command) == once


def test_a_refinement_without_time_makes_no_iteration_and_keeps_back_one_key_packet(tmp_path: Path) -> None:
    """All frames are there at once: another one always waits. Players can join at the second key packet."""
    _, live = growing(tmp_path, *range(8), frames=8)
    (live / "END").touch()
    encode(tmp_path / "run", source=f"watch:{live}", codec__key_interval=2, **{**QUICK, **REFINED})
    lines = metrics(tmp_path / "run")
    assert [line["status"] for line in lines] == ["key", *5 * ["delta"], "key", "delta"]
    assert lines[6]["key_reason"] == "period"
    assert sum(line.get("refine_iterations", 0) for line in lines) == 0
