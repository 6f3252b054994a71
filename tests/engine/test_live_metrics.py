"""What a run says of its latency: one frame, and the whole run."""

from __future__ import annotations

import json

import numpy as np
import pytest

from gsstream.core.cameras import Cameras
from gsstream.core.frame import Arrival, Frame
from gsstream.engine.run.live import COUNTED, latency_lines, latency_words, live_metrics

RIG = Cameras(
    ("a", "b"), np.eye(4)[None].repeat(2, 0).astype(np.float32), np.eye(3)[None].repeat(2, 0).astype(np.float32), 8, 8
)


def entry(index: int, effort: float, arrival: Arrival | None, written: float = 12.0) -> dict | None:
    """As metrics.jsonl has it, through JSON."""
    frame = Frame(index, 0.0, np.zeros((2, 8, 8, 3), np.float32), RIG, effort, arrival)
    return json.loads(json.dumps(live_metrics(frame, written)))


def line(index: int, latency: float | None, policy: str | None = None) -> dict:
    return {"frame": index, "live": {"latency_seconds": latency, "policy": policy, "epoch_scale": 1.0, "absent": []}}


@pytest.mark.parametrize(
    ("index", "effort", "absent", "policy"),
    [
        (3, 1.0, (), None), (3, 0.5, (), "hurried"), (3, 0.0, (), "dropped"), (3, 1.0, ("b",), "held"),
        (3, 0.5, ("b",), "hurried"), (3, 0.0, ("b",), "missing"), (0, 0.0, (), None), (0, 0.5, (), None),
    ],
)  # fmt: skip
def test_a_frame_has_one_policy_and_frame_0_none(
    index: int, effort: float, absent: tuple[str, ...], policy: str | None
) -> None:
    got = entry(index, effort, Arrival(10.5, absent))
    assert got == {"latency_seconds": 1.5, "policy": policy, "epoch_scale": effort, "absent": list(absent)}


def test_a_clock_that_is_ahead_shows_and_nothing_is_said_of_recordings_that_are_not_live() -> None:
    early, gone = entry(1, 1.0, Arrival(13.0)), entry(1, 1.0, Arrival(None))
    assert early is not None
    assert gone is not None
    assert (early["latency_seconds"], gone["latency_seconds"]) == (-1.0, None)
    assert latency_words({"live": gone}) == ["latency unknown"]
    assert entry(1, 1.0, None) is None
    assert (
        latency_words({"live": None})
        == latency_words({})
        == latency_lines([{"frame": 0}, {"frame": 1, "live": None}])
        == []
    )


def test_the_summary_leaves_dropped_frames_out_of_the_latency_and_counts_them() -> None:
    lines = [line(0, 40.0), line(1, 4.0), line(2, 3.0, "hurried"), line(3, 90.0, "dropped"), line(4, 1.0, "held"),
             line(5, 80.0, "missing"), line(6, 2.0), line(7, 70.0, "dropped")]  # fmt: skip
    assert latency_lines(lines) == [
        "latency from image to packet: frame 0 40.00 s; later frames: median 2.50 s, worst 4.00 s (frame 1)",
        "of 7 later frames: 2 dropped because the run was behind, 1 dropped because a camera's image did not come, "
        "1 hurried, 1 with held images",
        "frames dropped by a run that was behind are not measured above; gsstream evaluate measures all",
    ]
    assert latency_lines(lines[:1]) == ["latency from image to packet: frame 0 40.00 s"]
    assert latency_lines([line(0, None), line(1, None)])[0].endswith("unknown, the images were gone")
    assert latency_lines([line(3, 0.5)]) == [
        "latency from image to packet: later frames: median 0.50 s, worst 0.50 s (frame 3)",
        "of 1 later frames: none was dropped, hurried or held",
    ], "a run of which only the end is at hand"


@pytest.mark.parametrize("policy", [None, *COUNTED])
def test_every_policy_has_words(policy: str | None) -> None:
    assert latency_words(line(2, 0.256, policy))[0] == "0.26 s late"
    assert len(latency_words(line(2, 0.256, policy))) == 1 + (policy is not None)
    assert len(latency_lines([line(2, 0.2, policy)])) == 2 + (policy == "dropped")
