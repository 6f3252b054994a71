"""The tool that times frames on a GPU, where there is none: frames are there, and nothing was recorded."""

from __future__ import annotations

import json

import pytest
import torch

from gsstream.parts.render.replay import Records
from tools.gpu import main

SHORT = "synthetic:frames=3&views=4&width=48&height=32", "first_frame.max_iterations=8", "--frames", "2"


@pytest.mark.skipif(torch.cuda.is_available(), reason="expects a machine without a GPU")
def test_every_frame_is_a_line_twice_where_asked(capsys: pytest.CaptureFixture[str]) -> None:
    before = Records.call, Records._record, Records.can
    main([*SHORT, "--queued"])
    first, *rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert first["card"] is None
    assert [row["queued"] for row in rows] == [False, False, True, True]
    assert [row["what"].split(",")[0] for row in rows] == ["frame 0", "frame 1"] * 2
    assert [row["bytes"] for row in rows[:2]] == [row["bytes"] for row in rows[2:]]
    assert all(row["ms"] > 0 and row["records"] == {} for row in rows)
    assert before == (Records.call, Records._record, Records.can)


@pytest.mark.skipif(torch.cuda.is_available(), reason="expects a machine without a GPU")
def test_the_last_frame_says_what_it_did(capsys: pytest.CaptureFixture[str]) -> None:
    main([*SHORT, "--kernels"])
    _, first, last = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert "kernels" not in first
    names, spent, times = zip(*last["dearest"], strict=True)
    assert any(name.startswith("aten::") for name in names)
    assert list(spent) == sorted(spent, reverse=True)
    assert sum(spent) <= last["busy_ms"] + 0.1 <= last["ms"] + 0.2
    assert sum(times) <= last["kernels"]
