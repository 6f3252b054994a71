"""The drift job: the loop, its numbers, and a real small run."""

from __future__ import annotations

import json

import pytest

from gsstream.core.errors import OutputError
from tools.drift import Drift, main, there_and_back


def test_the_loop_never_jumps():
    order = [there_and_back(index, 4) for index in range(13)]
    assert order == [0, 1, 2, 3, 2, 1, 0, 1, 2, 3, 2, 1, 0]
    assert [there_and_back(index, 1) for index in range(3)] == [0, 0, 0]


def frame(psnr, moving, same=True, kind="delta"):
    return {"kind": kind, "bytes": 2000, "psnr": psnr, "psnr_moving": moving, "same": same}


def test_slope_and_ends():
    rows = [frame(90, None, kind="key")]
    rows += [frame(30 - 0.01 * i, None if i == 3 else 20 + 0.02 * i) for i in range(1, 9)]
    drift = Drift(tuple(rows))
    summary = drift.summary(4)
    assert summary["psnr_slope_db_per_100"] == pytest.approx(-1)
    assert summary["psnr_moving_slope_db_per_100"] == pytest.approx(2)
    assert summary["psnr_first_period"] == pytest.approx(30 - 0.025)
    assert summary["psnr_last_period"] == pytest.approx(30 - 0.065)
    assert summary["kb_per_frame"] == 2
    assert drift.different == []
    assert Drift((*rows, frame(1, 1, same=False))).different == [9]


def test_a_small_run_does_not_drift(tmp_path, capsys):
    source = "synthetic:frames=3&views=3&width=48&height=36&supersample=1"
    command = ["--source", source, "--frames", "6", "--out", str(tmp_path), "--set", "first_frame.max_iterations=20",
               "--set", "stream.epochs=2", "--set", "codec.key_interval=4"]  # fmt: skip
    assert main(command) == 0
    found = json.loads((tmp_path / "drift.json").read_text())
    assert json.loads(capsys.readouterr().out) == found["summary"]
    assert [f["kind"] for f in found["frames"]] == ["key", "delta", "delta", "delta", "key", "delta"]
    assert all(f["same"] for f in found["frames"])
    with pytest.raises(OutputError, match="exists"):
        main(command)
