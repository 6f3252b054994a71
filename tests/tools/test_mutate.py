"""Single changes of a tiny package: what is drawn, which tests are asked, and what is written down."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tools.changes import Change, changes_of, draw
from tools.mutate import files_asked, main

CODE = '''"""A docstring with 1 + 1."""

from pathlib import Path


def area(width: int, height: "int | None" = 2, root: Path = Path(".")) -> int:
    if width < 0:
        raise ValueError(f"{width - 1} is too small, by {0 - width}")
    print("sum", width + 1)
    folder = root / "a"
    return width * height


def unseen(value: float) -> bool:
    return not sorted([value], reverse=True)[0] > 0.5
'''
TEST = "from gsstream.shapes.boxes import area\n\n\ndef test_area():\n    assert [area(w) for w in (0, 3)] == [0, 6]\n"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A repository of one package, tested in part."""
    for name, text in (
        ("gsstream/shapes/boxes.py", CODE),
        ("tests/shapes/test_boxes.py", TEST),
        ("tests/flow/test_all.py", TEST),
        ("tests/shapes/test_a_small_one.py", "def test_nothing():\n    pass\n"),
        ("gsstream/__init__.py", ""),
        ("tests/lines/test_lines.py", "def test_nothing():\n    pass\n"),
        ("tests/points/test_points.py", "from gsstream.shapes import boxes\n"),
        ("pytest.ini", "[pytest]\npythonpath = .\nmarkers = slow\n"),
    ):
        (tmp_path / "repository" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "repository" / name).write_text(text)
    return tmp_path / "repository"


def said(changes: list[Change]) -> set[str]:
    return {f"{change.line} {change.before}>{change.after}" for change in changes}


def test_what_is_changed_and_what_is_left_alone(root: Path) -> None:
    """Neither docstrings, annotations, messages, refusals as a whole nor paths."""
    found = changes_of(root, ["gsstream"])
    assert said(found) == {
        "6 2>3",
        "7 <><=",
        "7 0>1",
        "11 *>/",
        "15 not >",
        "15 , reverse=True>",
        "15 True>False",
        "15 0>1",
        "15 >>>=",
        "15 0.5>1.0",
    }
    data = (root / "gsstream/shapes/boxes.py").read_bytes()
    assert b"return width / height" in next(c for c in found if c.line == 11).apply(data)


def test_a_seed_draws_one_change_of_each_of_some_lines(root: Path) -> None:
    found = changes_of(root, ["gsstream"])
    assert draw(root, found, 3, 0) == draw(root, found, 3, 0)
    draws = [draw(root, found, 9, seed) for seed in range(20)]
    assert all(sorted(change.line for change in drawn) == [6, 7, 11, 15] for drawn in draws)
    assert len({change for drawn in draws for change in drawn}) > 6


def test_tests_that_name_the_module_come_first_and_whole_runs_last(root: Path) -> None:
    change = changes_of(root, ["gsstream"])[0]
    assert files_asked(root, change) == [
        "tests/points/test_points.py",
        "tests/shapes/test_boxes.py",
        "tests/shapes/test_a_small_one.py",
        "tests/flow/test_all.py",
    ]


def test_every_change_has_a_line_and_a_second_run_makes_none_twice(root: Path, tmp_path: Path) -> None:
    before = {path: path.read_bytes() for path in root.rglob("*.py")}
    arguments = ["gsstream", "--seed", "3", "--root", str(root), "--out", str(tmp_path / "out")]
    assert main([*arguments, "--count", "2"]) in (0, 1)
    assert main([*arguments, "--count", "4"]) == 1
    lines = [json.loads(line) for line in (tmp_path / "out/changes.jsonl").read_text().splitlines()]
    found = {line["line"]: (line["result"], line["test"].partition(" ")[0]) for line in lines}
    assert len(lines) == 4
    assert found[11] == ("noticed", "tests/shapes/test_boxes.py::test_area")
    assert found[15] == ("not noticed", "")
    assert {path: path.read_bytes() for path in root.rglob("*.py")} == before, "the repository itself is never changed"


def test_a_test_that_fails_anyway_notices_nothing_and_one_without_end_is_a_timeout(root: Path, tmp_path: Path) -> None:
    (root / "tests/shapes/test_boxes.py").write_text("def test_wrong():\n    assert False\n")
    arguments = ["gsstream", "--seed", "3", "--root", str(root), "--count", "1", "--out"]
    assert main([*arguments, str(tmp_path / "wrong")]) == 0
    (root / "tests/shapes/test_boxes.py").write_text("while True:\n    pass\n")
    assert main([*arguments, str(tmp_path / "endless"), "--limit", "1"]) == 1
    found = [(tmp_path / name / "changes.jsonl").read_text() for name in ("wrong", "endless")]
    assert [json.loads(line)["result"] for line in found] == ["noticed", "timeout"]
    assert json.loads(found[0])["test"] == "tests/flow/test_all.py::test_area"
