"""The comparison of formats: every row is measured, and readers give back what was written."""

from __future__ import annotations

import json
import shutil

import pytest
from moving_scenes import moving_packets
from test_foreign_exports import scene_of
from test_player import make_stream

from gsstream.packet import StreamWriter
from tools.formats import main

pytest.importorskip("fourdgs", reason="fourdgs is not installed (the extra fourdgs)")
pytest.importorskip("pxr", reason="usd-core is not installed (the extra usd)")
ALWAYS = {"gsstream", "4dgs, export", "4dgs, deltas", "numbered PLY", "numbered SPZ 3", "numbered GLB", "OpenUSD"}


def rows_of(capsys, *arguments: str) -> dict[str, dict]:
    assert main(arguments) == 0
    return {row["format"]: row for row in map(json.loads, capsys.readouterr().out.splitlines())}


def test_every_format_is_measured(tmp_path, capsys):
    stream = make_stream(tmp_path / "s.gss", 2, scene=scene_of(15))
    rows = rows_of(capsys, str(stream))
    assert rows.keys() >= ALWAYS
    assert {rows[name]["dB"] for name in ("numbered PLY", "OpenUSD")} == {"over 100"}
    assert all(row["frames"] == 2 for row in rows.values())
    assert rows["4dgs, export"]["dB"] > 40
    assert rows["numbered GLB"]["dB"] > 40, "its reader here keeps coefficients as bytes"
    assert rows["4dgs, deltas"]["dB"] < 40, "without harmonics the picture is another one"
    ply = rows["numbered PLY"]
    assert ply["KB"] == pytest.approx(2 * (150 * 62 * 4 + 1000) / 1e3, rel=0.05)
    assert ply["of_ours"] == pytest.approx(ply["KB"] * 1e3 / stream.stat().st_size, rel=0.05)
    if shutil.which("splat-transform"):
        assert rows["numbered SPZ 3"]["dB"] == pytest.approx(rows["numbered SPZ 4"]["dB"], abs=2)
    if shutil.which("splat4d"):
        assert rows["splats4D"]["dB"] == pytest.approx(rows["4dgs, deltas"]["dB"], abs=3)


def test_rows_that_come_and_go_are_told_apart(tmp_path, capsys):
    """Deltas name Gaussians by number: a wrong number would draw another picture."""
    with StreamWriter.open(tmp_path / "s.gss") as writer:
        for packet in moving_packets(seed=8, frames=10, number=90, sh_rest=0):
            writer.append(packet)
    rows = rows_of(capsys, str(tmp_path / "s.gss"))
    assert rows["numbered PLY"]["dB"] == "over 100"
    assert rows["4dgs, deltas"]["dB"] == pytest.approx(rows["4dgs, export"]["dB"], abs=1)
    few = rows_of(capsys, str(tmp_path / "s.gss"), "--frames", "2")
    assert few["OpenUSD"]["frames"] == 2
    assert few["OpenUSD"]["KB"] < rows["OpenUSD"]["KB"]
