"""The small measuring scripts: what they print is what they measured."""

from __future__ import annotations

from pathlib import Path

import pytest
from flow_runs import TINY, WORLD, encode

from tools import checks_cost, precision


def table(text: str) -> dict[tuple[str, str], list[float]]:
    """(first, second column) -> the numbers behind them."""
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines()[2:]]
    return {(row[0], row[1]): [float(cell) for cell in row[2:]] for row in rows}


def test_half_floats_cost_what_they_cost(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    encode(tmp_path, "--frames", "3")
    assert precision.main([str(tmp_path / "stream.gss")]) == 0
    rows = table(capsys.readouterr().out)
    assert len(rows) == 2 * (7 + 5)
    for name in ("all", "record: 2-D mean"):
        (fine, better), (coarse, worse) = rows[name, "float16"], rows[name, "bfloat16"]
        assert 0 <= fine < coarse <= 1
        assert 20 < worse < better <= 200


def test_every_level_of_checks_is_timed_on_the_same_packets(capsys: pytest.CaptureFixture[str]) -> None:
    sets = [item for key, value in TINY.items() for item in ("--set", f"{key}={value}")]
    assert checks_cost.main(["--source", WORLD, "--frames", "1", *sets]) == 0
    rows = capsys.readouterr().out.splitlines()[2:]
    assert [row.split("|")[1].strip() for row in rows] == ["off", "frame", "step"]
    assert all(float(row.split("|")[2]) > 0 for row in rows)
    assert rows[0].endswith("| 1.000 |")
