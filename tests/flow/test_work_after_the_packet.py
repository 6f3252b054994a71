"""A frame's packet does not wait for the refinement of an early frame 0, and a kill meanwhile costs no bit."""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Iterator
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


def test_no_latency_contains_its_own_refinement_but_the_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By a clock on which every refinement takes a thousand seconds; the packet is in the file when it begins."""
    clock, held = [0.0], []
    advanced = refine.advance_refinement

    def slow(*args: Any, **named: Any) -> Any:
        clock[0] += 1000.0
        held.append(written(tmp_path / "run" / "stream.gss")[-1])
        return advanced(*args, **named)

    monkeypatch.setattr(refine, "advance_refinement", slow)
    shifted = SimpleNamespace(time=lambda: time.time() + clock[0], perf_counter=time.perf_counter)
    monkeypatch.setattr(session, "time", shifted)
    folder = demo_copy(tmp_path / "scene", frames=5)
    for image in folder.glob("*/*.jpg"):
        image.touch()  # latency counts from here
    encode(tmp_path / "run", source=f"watch:{folder}", **{**QUICK, **REFINED})
    assert held == [1, 2, 2], "frame 3 brings the refined scene: its packet follows its iterations"
    lines = metrics(tmp_path / "run")
    assert [int(line["live"]["latency_seconds"] // 1000) for line in lines] == [0, 0, 1, 3, 3]
    assert [line.get("refine_iterations", 0) for line in lines] == [0, 6, 6, 6, 0]


def test_frames_that_come_during_the_refinement_wait_as_the_policy_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A packet that is out does not make the encoder idle: four frames come while frame 1 is refined."""
    finished, live = demo_copy(tmp_path / "scene", frames=6), tmp_path / "live"
    capture.begin(finished, live)
    patterns = [camera["frames"] for camera in json.loads((live / "cameras.json").read_text())["cameras"]]

    def come(frame: int) -> None:
        for pattern in patterns:
            (live / (pattern % frame)).parent.mkdir(exist_ok=True)
            shutil.copy(finished / (pattern % frame), live / "part")
            (live / "part").replace(live / (pattern % frame))

    come(0)
    come(1)
    advanced = refine.advance_refinement

    def busy(*args: Any, **named: Any) -> Any:
        if named["frame"].index == 1:
            for frame in range(2, 6):
                come(frame)
            (live / "END").touch()
        return advanced(*args, **named)

    monkeypatch.setattr(refine, "advance_refinement", busy)
    source = f"watch:{live}?behind=drop&queue=1&ready=rename"
    encode(tmp_path / "run", source=source, **{**QUICK, **REFINED})
    lines = metrics(tmp_path / "run")
    assert [line["live"]["policy"] for line in lines] == [None, None, "dropped", "dropped", "dropped", None]
    assert [line.get("refine_iterations") for line in lines] == [None, 6, 0, 0, 0, 6]
