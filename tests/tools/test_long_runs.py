"""Long runs account for every frame: a real boomerang, and the sums of an hour."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from flow_runs import TINY

from gsstream.core.errors import InputError
from tools.boomerang import main, parts_of
from tools.hour import instants_of
from tools.sampling import Lines, grown


def test_a_boomerang_turns_and_counts_its_frames(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    settings = [word for key, value in TINY.items() for word in ("--set", f"{key}={value}")]
    settings += ["--scale", "0.2", "--method", "dense"]
    assert main(["--frames", "15", "--out", str(tmp_path / "out"), "--", *settings]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found == json.loads((tmp_path / "out" / "boomerang.json").read_text())
    assert (found["frames"], found["lines"], found["frames_decoded"]) == (15, 15, 15)
    assert sum(found["packets"].values()) == 15
    assert [part["frames"] for part in found["parts"]] == [f"{t} to {t + 1}" for t in range(1, 15, 2)]
    with pytest.raises(InputError, match="expected a new folder"):
        main(["--frames", "15", "--out", str(tmp_path / "out")])


def test_parts_are_means_of_their_frames() -> None:
    def line(frame: int, psnr: float | None) -> dict[str, Any]:
        size = {"header": 16, "means": frame}
        return {"frame": frame, "psnr": {"a": psnr}, "bytes": size, "cpu_seconds": 0.5, "num_gaussians": 7 + frame}

    first, *_, last = parts_of([line(0, 9.0), *(line(t, None if t == 2 else float(t)) for t in range(1, 21))])
    assert first == {"frames": "1 to 2", "psnr": 1.0, "bytes": 17.5, "cpu_ms": 500.0, "gaussians": 9}
    assert (last["frames"], last["psnr"]) == ("19 to 20", 19.5)


def told(time: float, dropped: int = 0, absent: tuple[str, ...] = ()) -> dict[str, Any]:
    return {"time": time, "dropped": dropped, "absent": list(absent)}


def test_every_instant_is_captured_dropped_or_of_no_camera() -> None:
    """Two a second: 1.5 is dropped by the capture, 2.5 to 3.5 have no picture of any camera."""
    lines = [told(0), told(0.51), told(1.0, absent=("b",)), told(2.01, 1), told(4.0, 1, ("a", "b")), told(4.5, 1)]
    assert instants_of(lines, 2.0) == {
        "instants_by_the_clock": 10,
        "captured": 6,
        "of_all_cameras": 4,
        "dropped_by_the_capture": 1,
        "without_any_camera": 3,
        "pictures_absent": 3,
        "absent": {"b": 2, "a": 1},
    }


def test_growth_is_told_by_fifths() -> None:
    def sample(mb: int) -> dict[str, Any]:
        facts = {"mb": mb, "descriptors": 7, "threads": 3}
        return {"run": facts, "capture": None, "frames": 1, "files_of_the_run": 5}

    before = sample(900) | {"frames": 0}
    found = grown([before, *map(sample, range(11))])
    assert found["run_mb"] == [2, 4, 6, 8, 10]
    assert (found["run_most_mb"], found["run_most_descriptors"], found["files_of_the_run"]) == (10, 7, 5)
    assert not any(name.startswith("capture") for name in found)


def test_lines_are_counted_as_they_come(tmp_path: Path) -> None:
    lines = Lines(tmp_path / "log.jsonl")
    assert lines.count() == 0
    with (tmp_path / "log.jsonl").open("a") as file:
        for text, whole in (("a\nb\nhal", 2), ("f\n", 3), ("", 3)):
            file.write(text)
            file.flush()
            assert lines.count() == whole
