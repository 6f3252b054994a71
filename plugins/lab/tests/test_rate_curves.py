"""Curves of quality against bytes: which recipes make one, and the Bjøntegaard delta against a second computation."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from gsstream_lab.report.build import build_report
from gsstream_lab.report.document import Picture, Table
from gsstream_lab.report.groups import read_sweep_data
from gsstream_lab.report.rate_curves import bd_rate, curves_over
from hypothesis import given
from hypothesis import strategies as st
from test_report import make_table

ANCHOR = [(5.0, 30.0), (10.0, 31.0), (20.0, 31.7), (40.0, 32.0)]


@given(st.floats(0.1, 10), st.floats(-20, 20))
def test_fewer_bytes_everywhere_are_that_many_percent(factor: float, shift: float) -> None:
    other = [(factor * size, quality + shift) for size, quality in ANCHOR]
    anchor = [(size, quality + shift) for size, quality in ANCHOR]
    assert bd_rate(anchor, other) == pytest.approx(100 * (factor - 1), abs=1e-6)


def test_straight_lines_agree_with_the_integral() -> None:
    # Where log bytes are linear in quality every monotone interpolation is the line itself.
    anchor = [(math.exp(q / 2), float(q)) for q in (0, 1, 2, 3)]
    other = [(math.exp(0.3 + 0.4 * q), float(q)) for q in (1, 2, 4, 5)]
    q = np.linspace(1, 3, 100_001)
    expected = 100 * (math.exp(float(np.mean(0.3 + 0.4 * q - q / 2))) - 1)
    assert bd_rate(anchor, other) == pytest.approx(expected, abs=1e-3)
    assert bd_rate(other, anchor) == pytest.approx(100 * (1 / (1 + expected / 100) - 1), abs=1e-3)


@pytest.mark.parametrize(
    "other",
    [
        ANCHOR[:2],
        [],
        [(size, quality - 10) for size, quality in ANCHOR],
        [(size, quality + 2) for size, quality in ANCHOR],
        [(0.0, 29.0), *ANCHOR],
    ],
    ids=["two points", "none", "all worse", "touching at one quality", "no bytes"],
)
def test_what_cannot_be_compared_is_nan(other: list[tuple[float, float]]) -> None:
    assert math.isnan(bd_rate(ANCHOR, other))
    assert math.isnan(bd_rate(other, ANCHOR))


def cells_of(variant: str, factor: float, weights=(1, 2, 3)):
    qualities = {1: (32.0, 40.0), 2: (31.0, 15.0), 3: (30.0, 5.0)}
    return [("a", variant, {"stream.rd_lambda": w}, 0, qualities[w][0], factor * qualities[w][1], 1.0) for w in weights]


def test_the_report_has_a_table_and_a_picture_of_each_axis(tmp_path: Path) -> None:
    short, plain = cells_of("short", 0.5, (1, 2)), ("a", "plain", {}, 0, 31.0, 9.0, 1.0)
    cells = [*cells_of("gates", 1.0), *cells_of("groups", 0.5), *short, plain]
    data = read_sweep_data(make_table(tmp_path / "swept", cells))
    (curves,) = curves_over(data.of("a")).values()
    assert [(curve.name, len(curve.groups)) for curve in curves] == [("gates", 3), ("groups", 3)]
    blocks = build_report(data, {})
    (table,) = [block for block in blocks if isinstance(block, Table) and block.caption.startswith("Curves over")]
    assert table.caption == "Curves over stream.rd_lambda, against gates"
    gates, groups = table.rows[1:]
    assert gates[:5] == ["gates", "1 to 3", "40.0 to 5.0", "33.00 to 31.00", "-"]
    assert groups[:5] == ["groups", "1 to 3", "20.0 to 2.5", "33.00 to 31.00", "-50 %"]
    (picture,) = [block for block in blocks if isinstance(block, Picture) and "curves" in block.name]
    assert picture.name == "a-rd_lambda-curves.png"
    assert picture.data.startswith(b"\x89PNG")


def test_a_single_family_makes_no_curves(tmp_path: Path) -> None:
    data = read_sweep_data(make_table(tmp_path / "swept", cells_of("gates", 1.0)))
    assert curves_over(data.of("a")) == {}


def test_points_that_cost_more_for_no_more_quality_are_left_out(tmp_path: Path) -> None:
    beaten = ("a", "gates", {"stream.rd_lambda": 4}, 0, 30.5, 20.0, 1.0)
    cells = [*cells_of("gates", 1.0), beaten, *cells_of("other", 2.0)]
    data = read_sweep_data(make_table(tmp_path / "swept", cells))
    gates = curves_over(data.of("a"))["stream.rd_lambda"][0]
    assert len(gates.groups) == 4
    assert gates.points("psnr") == [(5.0, 31.0), (15.0, 32.0), (40.0, 33.0)]
