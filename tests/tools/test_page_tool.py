"""What is measured of the page of a package: the synthetic stream, the page of another commit, the rows."""

from __future__ import annotations

import itertools
import subprocess

import numpy as np
import pytest

from gsstream.player.playback import Playback
from gsstream.serve.package import package
from tools.page import ROOT, row_of, with_page_of, write_synthetic


def test_a_twentieth_of_a_synthetic_stream_changes(tmp_path):
    write_synthetic(tmp_path / "s.gss", 2000, 6)
    with Playback(tmp_path / "s.gss") as playback:
        scenes = [playback.state_at(frame) for frame in playback.frames]
        kinds = [playback.entry(frame).kind.name for frame in playback.frames]
    assert [len(scene) for scene in scenes] == [2000] * 6
    assert kinds == ["KEY", "DELTA", "DELTA", "KEY", "DELTA", "DELTA"]
    changed = [(a.means != b.means).any(1).mean() for a, b in itertools.pairwise(scenes)]
    assert 0.02 < np.mean([changed[i] for i in (0, 1, 3, 4)]) < 0.08


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="this is no checkout (git clone)")
def test_the_page_of_another_commit_shows_the_same_stream(tmp_path):
    write_synthetic(tmp_path / "s.gss", 100, 2)
    package(tmp_path / "s.gss", tmp_path / "site")
    head = subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True, check=True)
    other = with_page_of(tmp_path / "site", head.stdout.strip(), tmp_path / "other")
    assert (other / "stream.json").read_bytes() == (tmp_path / "site" / "stream.json").read_bytes()
    committed = subprocess.run(
        ["git", "show", "HEAD:gsstream/web/player.js"], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert (other / "player.js").read_text() == committed.stdout


def test_a_row_has_every_round_of_times_and_the_worst_of_tasks():
    longest = ({"wall": 9, "cpu": 3.5}, {"wall": 9, "cpu": 5.0})
    runs = [
        {
            "first": 1000 + i,
            "whole": 2000,
            "processor": 0.5,
            "decoded": "in a worker",
            "longest": each,
            "long": i,
            "perPicture": 2.0,
        }
        for i, each in enumerate(longest)
    ]
    row = row_of({"frames": 3}, "abc", runs)
    assert (row["first_picture_s"], row["longest_task_ms"], row["tasks_above_16_ms"]) == ("1.00, 1.00", 5.0, 1)
