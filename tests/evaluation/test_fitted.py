"""Tables on a terminal: what does not fit stands upright, and no cell is lost."""

from __future__ import annotations

import math

from hypothesis import given
from hypothesis import strategies as st

from gsstream.engine.run.progress import frame_line
from gsstream.evaluation.summary import Summary, fitted, format_table, summary_table

CELLS = st.text("abc 0123.-", min_size=1, max_size=12).map(lambda text: text.strip() or "-")


def tables(columns: int) -> st.SearchStrategy[list[list[str]]]:
    return st.lists(st.lists(CELLS, min_size=columns, max_size=columns), min_size=2, max_size=4)


@given(rows=st.integers(1, 5).flatmap(tables), width=st.integers(1, 120))
def test_every_cell_is_there_and_what_fits_is_untouched(rows: list[list[str]], width: int) -> None:
    text = "\n".join(["before", format_table(rows), "", "after"])
    shown = fitted(text, width)
    if max(map(len, text.splitlines())) <= width:
        assert shown == text
    table = [line for line in shown.splitlines() if line.startswith("|") and not line.startswith("|-")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in table]
    assert cells in (rows, [list(column) for column in zip(*rows, strict=True)])
    assert shown.splitlines()[0] == "before"
    assert shown.splitlines()[-1] == "after"


def summary(frames: int, kb: float) -> Summary:
    return Summary(frames, 25.0, 24.0, -47.69, 0.9, 23.0, kb, 9.0, 3.0, 10.0, 1.0, 0.1, 0.1, 300.0, math.nan)


def test_a_run_stands_in_eighty_columns() -> None:
    shown = fitted(summary_table({"s2gs-fast + gate=always-open, stream.epochs=3": summary(12, 3.0)}), 80)
    assert max(map(len, shown.splitlines())) <= 80
    assert "KB/frame" in shown


def test_numbers_that_say_nothing_are_not_shown() -> None:
    assert "-47.69" not in summary_table({"r": summary(3, 3.0)})
    assert "-47.69" in summary_table({"r": summary(10, 3.0)})
    assert "0.016" in summary_table({"r": summary(3, 0.016)})
    line = {"frame": 1, "bytes": {"header": 16}, "seconds": {"code": 0.1}, "num_gaussians": 0, "sent_gaussians": 0}
    assert "16 B" in frame_line(line, 3)
