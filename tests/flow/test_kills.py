"""A run that is killed at any write goes on to the stream, the lines and the summary of the run that nobody killed."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from gsstream.discovery.catalog import load_catalog
from tools.kills import Journal, Write, difference, kills, noted, replay, try_method

#: One method is killed at every write; of the others, one after the other, at places that fall elsewhere for each.
EVERY = {"s2gs-edge": 1, "queen": 9, "comgs-l": 11, "stream3dgs": 13, "hicom": 13, "recon": 13, "quarc": 13, "hold": 13}
KNOWN = set(load_catalog().names("method"))


@pytest.mark.parametrize("method", [name for name in EVERY if name in KNOWN])
def test_killed_at_any_write_it_ends_as_if_nobody_had(method: str, tmp_path: Path) -> None:
    number, wrong = try_method(method, tmp_path, EVERY[method])
    assert wrong == []
    assert number >= 2


def test_the_kills_of_a_run_with_key_packets(tmp_path: Path) -> None:
    assert try_method("s2gs-edge", tmp_path, 4, "--set", "codec.key_interval=1")[1] == []


def test_a_missing_line_is_noticed(tmp_path: Path) -> None:
    """What the comparison is for: a run whose frame 0 has a packet and no line."""
    whole = tmp_path / "whole"
    try_method("hold", tmp_path, 1000)
    other = tmp_path / "other"
    other.mkdir()
    for path in whole.iterdir():
        (other / path.name).write_bytes(path.read_bytes())
    assert difference(other, whole) == ""
    lines = (other / "metrics.jsonl").read_text().splitlines(keepends=True)
    (other / "metrics.jsonl").write_text("".join(lines[1:]))
    assert difference(other, whole) == "lines of frames [1, 2]"
    (other / "metrics.jsonl").write_text(lines[0].replace('"status": "key"', '"status": "delta"') + "".join(lines[1:]))
    assert difference(other, whole) == "frame 0: status"


def test_the_journal_sees_what_reaches_the_disk(tmp_path: Path) -> None:
    folder = tmp_path / "a"
    folder.mkdir()
    with noted(folder) as journal:
        (folder / "text").write_text("one")
        with (folder / "text").open("a") as file:
            file.write("two")
        with (folder / "bytes").open("wb", buffering=0) as raw:
            raw.write(b"12345678")
            raw.seek(2)
            raw.write(b"xx")
            raw.truncate(6)
        (folder / "text").replace(folder / "moved")
        (folder / "gone").touch()
        os.unlink(folder / "gone")
        (tmp_path / "outside").write_text("not noted")
    replay(journal.writes, tmp_path / "b")
    made = {path.name: path.read_bytes() for path in (tmp_path / "b").iterdir()}
    assert made == {"moved": b"onetwo", "bytes": b"12xx56"}
    torn = [done[-1].data for name, done in kills(journal.writes) if name.startswith("in write")]
    assert torn == [b"o", b"t", b"1234", b"x"]
    assert Journal(folder).name_of(tmp_path / "outside") is None
    assert Write("create", "gone") in journal.writes
