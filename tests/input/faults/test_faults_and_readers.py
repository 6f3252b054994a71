"""Kinds of fault x readers: no cell is silently wrong, and all doors say the same."""

from __future__ import annotations

import json

import pytest

from tests.input.faults.readers import READERS
from tests.input.faults.table import CELLS, FAULTS, cell

KNOWN = json.loads(CELLS.read_text(encoding="utf-8"))


def test_every_kind_of_fault_is_tried_on_every_reader() -> None:
    assert list(KNOWN) == list(FAULTS), "python -m tests.input.faults.table"
    assert all(list(row) == list(READERS) for row in KNOWN.values())
    assert not [
        (fault, name) for fault, row in KNOWN.items() for name, (verdict, _) in row.items() if verdict == "wrong"
    ]
    applied = [verdict for row in KNOWN.values() for verdict, _ in row.values() if verdict != "does not apply"]
    assert len(applied) > 400


@pytest.mark.parametrize("name", READERS)
def test_no_reader_is_silently_wrong(name: str) -> None:
    """Each cell is made and read again; python -m tests.input.faults.table writes what comes out."""
    if READERS[name].films:
        pytest.importorskip("av")
    for fault, row in KNOWN.items():
        verdict, words = cell(fault, name)
        assert verdict == row[name][0], f"{fault}: {words}"
