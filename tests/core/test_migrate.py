"""docs/howto/migrate.md says what became of every public name and kind that went, and names only what there is."""

from __future__ import annotations

import functools
import importlib
import json
import re
from pathlib import Path

import pytest
from test_public_names import DOORS

from gsstream.core.kinds import PART_KINDS

FORMER = [json.loads(path.read_text()) for path in sorted(Path(__file__).with_name("former_names").glob("*.json"))]
PAGE = Path(__file__).parents[2] / "docs" / "howto" / "migrate.md"
CODE = re.compile(r"`([^`]+)`")


def rows(heading: str) -> list[tuple[str, str, str]]:
    """The three columns of the table under a heading, its head left out."""
    section = PAGE.read_text(encoding="utf-8").split(f"\n## {heading}\n")[1].split("\n## ")[0]
    lines = [line for line in section.splitlines() if line.startswith("|")][2:]
    return [tuple(cell.strip() for cell in line.strip("|").split("|")) for line in lines]  # type: ignore[misc]


@functools.cache
def is_exported(door: str, name: str) -> bool:
    return hasattr(importlib.import_module(f"gsstream.{door}"), name)


def gone(former: dict[str, object]) -> set[str]:
    """Names of a former interface that their door no longer has."""
    return {n for door, names in former["names"].items() for n in names if not is_exported(door, n)}  # type: ignore[attr-defined]


def table(heading: str) -> dict[str, str]:
    """Name -> the last interface that had it, as the page says."""
    said = [(name, until) for until, names, _ in rows(heading) for name in CODE.findall(names)]
    names = [name for name, _ in said if not name.startswith("gsstream.")]
    assert len(names) == len(set(names)), f"twice in the table: {sorted(n for n in names if names.count(n) > 1)}"
    return dict(said)


@pytest.mark.parametrize("heading", ["Names", "Kinds"])
def test_whatever_went_is_in_the_table_with_its_last_number(heading: str) -> None:
    last: dict[str, str] = {}
    for former in FORMER:
        left = gone(former) if heading == "Names" else set(former["kinds"]) - {*PART_KINDS}
        last |= dict.fromkeys(sorted(left), former["version"])
    said = {name: until for name, until in table(heading).items() if not name.startswith("gsstream.")}
    assert last.keys() - said.keys() == set(), "went, and the page does not say what became of it"
    assert said.keys() - last.keys() == set(), "the page says that they went, and they are there or never were"
    assert {name: until for name, until in said.items() if until != last[name]} == {}
    assert len(last) > 3


def test_what_the_page_sends_to_exists() -> None:
    named = re.findall(r"\bgsstream\.([a-z]+)\.(\w+)", PAGE.read_text(encoding="utf-8"))
    assert len(named) > 30
    assert [f"gsstream.{door}.{name}" for door, name in named if not is_exported(door, name)] == []


def test_records_and_calls_that_the_page_tells_to_write_exist() -> None:
    told = [word for _, _, new in rows("What is called, and with what") for word in CODE.findall(new)]
    classes = {name for text in told for name in re.findall(r"\b([A-Z][a-z]\w+)", text)} - {"None"}
    assert {name for name in classes if not any(is_exported(door, name) for door in DOORS)} == set()
    assert len(classes) > 8


def test_fields_that_the_page_tells_to_write_exist() -> None:
    told = [word for _, _, new in rows("What is called, and with what") for word in CODE.findall(new)]
    fields = [found for text in told for found in re.findall(r"^([A-Z][a-z]\w+)\.(\w+)$", text)]
    for name, field in fields:
        record = next(getattr(importlib.import_module(f"gsstream.{d}"), name) for d in DOORS if is_exported(d, name))
        assert hasattr(record, field) or field in record.__annotations__, f"{name}.{field}"
    assert len(fields) > 10


def test_the_same_names_are_in_the_door_that_is_said() -> None:
    for _, names, new in rows("Names"):
        door = re.fullmatch(r"the same names of `gsstream\.(\w+)`", new)
        if door:
            assert [n for n in CODE.findall(names) if not is_exported(door[1], n)] == []
