"""The live drill: a real capture at its rate, a real run behind it, and numbers that are those of the run."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import pytest
from flow_runs import TINY, demo_copy

from gsstream.core.errors import GsstreamError, OutputError
from gsstream.engine.run.metrics_log import read_metrics
from tools.drill import Capture, main, reported, there_and_back


def line(index: int, latency: float, policy: str | None = None, **more: Any) -> dict[str, Any]:
    live = {"latency_seconds": latency, "policy": policy, "epoch_scale": 1.0, "absent": []}
    sizes = {"frame": index, "status": "delta", "bytes": {"header": 1000}, "seconds": {"code": 2.0}, "cpu_seconds": 1.0}
    return {**sizes, "live": live, **more}


def test_the_loop_never_jumps() -> None:
    order = [there_and_back(index, 4) for index in range(13)]
    assert order == [0, 1, 2, 3, 2, 1, 0, 1, 2, 3, 2, 1, 0]
    assert [there_and_back(index, 1) for index in range(3)] == [0, 0, 0]


def test_dropped_frames_do_not_count_for_latency() -> None:
    lines = [
        line(0, 50.0),
        line(1, 3.0),
        line(2, 9.0, "dropped"),
        line(3, 1.0, "hurried"),
        line(4, 2.0, status="key", bytes={"header": 5000}),
        line(5, 4.0, "held"),
    ]
    found = reported(lines)
    assert [found[name] for name in ("dropped", "missing", "hurried", "held", "keys_later")] == [1, 0, 1, 1, 1]
    assert (found["latency_first_s"], found["latency_median_s"], found["latency_worst_s"]) == (50.0, 2.5, 4.0)
    assert (found["latency_p90_s"], found["latency_median_of_second_half_s"]) == (4.0, 2.0)
    assert found["kb_per_frame"] == 1.0
    assert reported(lines[:1])["latency_median_s"] is None


def test_frames_that_refine_are_told_apart() -> None:
    lines = [line(0, 50.0), *(line(t, t / 2, refine_iterations=20 if 2 <= t <= 4 else 0) for t in range(1, 7))]
    lines[3] = line(3, 9.0, "dropped", refine_iterations=0)
    lines += [line(7, 99.0)]
    assert reported(lines)["latency_median_while_refining_s"] == 1.5
    assert reported(lines[:2])["latency_median_while_refining_s"] is None


def test_a_capture_keeps_to_its_rate_and_shows_whole_files(tmp_path: Path) -> None:
    finished = demo_copy(tmp_path / "scene", frames=3)
    capture = Capture(finished, tmp_path / "live", 20.0, 6)
    assert "frames" not in json.loads((tmp_path / "live/cameras.json").read_text())
    began = time.time()
    capture.run()
    images = [tmp_path / f"live/cam00/{t:06d}.jpg" for t in range(6)]
    for t, (image, shown) in enumerate(zip(images, (0, 1, 2, 1, 0, 1), strict=True)):
        assert image.read_bytes() == (finished / f"cam00/{shown:06d}.jpg").read_bytes()
        # The kernel dates files by its clock tick, which may lie a hundredth of a second back.
        assert image.stat().st_mtime >= began + t / 20 - 0.02, "no image comes before its time"
    assert (tmp_path / "live/END").exists()
    assert not list(tmp_path.glob("live/*/*.part"))


def test_a_drill_reports_what_its_run_wrote(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    finished = demo_copy(tmp_path / "scene", frames=3)
    sets = [item for key, value in TINY.items() for item in ("--set", f"{key}={value}")]
    common = ["--source", str(finished), "--fps", "200", "--frames", "8", "--watch", "behind=drop&queue=1&ready=rename"]
    run = ["--", "--method", "dense", "--scale", "0.5", "--quiet", *sets]
    assert main([*common, "--out", str(tmp_path / "o"), *run]) == 0
    found = json.loads((tmp_path / "o/drill.json").read_text())
    lines = [entry for _, entry in read_metrics(tmp_path / "o/run/metrics.jsonl")]
    assert found["frames"] == len(lines) == 8
    # All images are there before frame 0 is made: what waits is dropped but for the newest.
    assert found["dropped"] == sum(entry["live"]["policy"] == "dropped" for entry in lines) > 0
    assert found["latency_first_s"] == lines[0]["live"]["latency_seconds"] > 0
    assert found["said"][0] in (tmp_path / "o/run/summary.txt").read_text()
    # Only frames that were not dropped have a number in the run, and evaluate has the same: the mean is of all.
    evaluated = found["psnr"]
    measured = {entry["frame"]: entry["psnr"]["cam03"] for entry in lines if "psnr" in entry}
    assert set(measured) == {entry["frame"] for entry in lines if entry["live"]["policy"] is None}
    assert 5 < evaluated < 60
    assert 0 < found["machine"]["used_by_the_run"] <= found["machine"]["processors"]
    with pytest.raises(OutputError, match="exists; expected a new folder"):
        main([*common, "--out", str(tmp_path / "o"), *run])
    with pytest.raises(GsstreamError, match="gsstream run ended with 2"):
        main([*common, "--out", str(tmp_path / "p"), "--", "--method", "no-such-method"])
    assert "no-such-method" in capfd.readouterr().err
