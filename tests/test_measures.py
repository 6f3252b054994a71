"""Measures of how simple the code is to follow. Each may only fall: a change that raises one finds another way."""

from __future__ import annotations

import ast
import re
import sys
import threading
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from types import FrameType
from typing import Any

from gsstream.core.kinds import PART_KINDS
from gsstream.encode import encoder_for, open_recording

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "gsstream"
PRODUCT = (f"{PACKAGE}/", f"{ROOT / 'plugins'}/")

#: Statements and functions that a later frame of s2gs-edge runs, and files they stand in.
ROAD = {"statements": 1887, "functions": 494, "files": 77}
#: Kinds of parts that a plugin can bring.
KINDS = 11
#: Names of the front doors that plugins import from.
PUBLIC_NAMES = 125
#: Files of the product that name one kind of part, growth, outside of the rooms of that kind.
NAMING_A_KIND = 8
#: Downcasts, and protocols that are asked for while the program runs, in the engine and in what comes in.
DOWNCASTS = 0
#: Tables that the formatter leaves alone.
TABLES = 91


class Road:
    """Statements and functions of the library that run while this is open, in every thread.

    Statements and not lines, so that the layout of a call does not count.
    """

    def __init__(self) -> None:
        self._lines: defaultdict[str, set[int]] = defaultdict(set)
        self._functions: set[tuple[str, str]] = set()

    def __enter__(self) -> Road:
        self._before = sys.gettrace(), threading.gettrace()
        threading.settrace(self._call)
        sys.settrace(self._call)
        return self

    def __exit__(self, *_: object) -> None:
        sys.settrace(self._before[0])
        threading.settrace(self._before[1])  # type: ignore[arg-type]

    def _call(self, frame: FrameType, event: str, _: Any) -> Any:
        code = frame.f_code
        if not code.co_filename.startswith(PRODUCT) or code.co_name == "<module>":
            return None
        self._functions.add((code.co_filename, code.co_qualname))
        return self._line

    def _line(self, frame: FrameType, event: str, _: Any) -> Any:
        if event == "line":
            self._lines[frame.f_code.co_filename].add(frame.f_lineno)
        return self._line

    def measures(self) -> dict[str, int]:
        statements = sum(len(set(map(owners(Path(name)).__getitem__, lines))) for name, lines in self._lines.items())
        return {"statements": statements, "functions": len(self._functions), "files": len(self._lines)}


def owners(path: Path) -> defaultdict[int, int]:
    """Line -> first line of the innermost statement that it belongs to."""
    found: defaultdict[int, int] = defaultdict(int)
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):  # breadth first: inner statements come later
        if isinstance(node, ast.stmt) and not isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.update(dict.fromkeys(range(node.lineno, (node.end_lineno or node.lineno) + 1), node.lineno))
    return found


def test_the_road_counts_statements_and_not_lines(tmp_path: Path) -> None:
    path = tmp_path / "example.py"
    path.write_text("def f():\n    return g(\n        1,\n        2,\n    )\n\n\nfor i in h:\n    j(\n        i)\n")
    assert [owners(path)[line] for line in (2, 3, 4, 8, 9, 10)] == [2, 2, 2, 8, 9, 9]


def test_the_road_of_a_later_frame_gets_no_longer() -> None:
    with open_recording("demo") as source:
        encoder = encoder_for("s2gs-edge", source, {"first_frame.max_iterations": 200})
        for index in range(2):  # the second frame imports and fills what is made once
            encoder.encode(source.frame(index))
        frame = source.frame(2)
        with Road() as road:
            encoder.encode(frame)
    measures = road.measures()
    assert measures["statements"] > 500, "the frame was not traced"
    assert {name: value for name, value in measures.items() if value > ROAD[name]} == {}


def test_there_are_no_more_kinds_of_parts() -> None:
    assert len(PART_KINDS) <= KINDS


def public_names(module: str) -> list[str]:
    """Names that a front door re-exports or defines."""
    tree = ast.parse((PACKAGE / f"{module}.py").read_text(encoding="utf-8"))
    imported = [a.asname for n in ast.walk(tree) if isinstance(n, ast.ImportFrom) for a in n.names if a.asname]
    defined = [n.name for n in tree.body if isinstance(n, ast.FunctionDef | ast.ClassDef)]
    return [name for name in imported + defined if not name.startswith("_")]


def test_authors_meet_no_more_names() -> None:
    doors = [name for name in ("api", "blocks", "backend") if (PACKAGE / f"{name}.py").is_file()]
    names = {name for door in doors for name in public_names(door)}
    assert 50 < len(names) <= PUBLIC_NAMES


def names_growth(path: Path) -> bool:
    """Whether a file's code, not its prose, names the kind of part."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        words = (getattr(node, field, None) for field in ("id", "attr", "arg", "value", "module"))
        if any(isinstance(w, str) and re.fullmatch(r"growth(/.*)?|.*\.parts\.growth\b.*", w) for w in words):
            return True
    return False


def test_no_more_files_name_a_kind_outside_of_its_rooms() -> None:
    own = ("parts/growth/", "testing/", "core/changes/", "packet/changes/", "input/")
    files = (path.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("*.py"))
    naming = sorted(name for name in files if not name.startswith(own) and names_growth(PACKAGE / name))
    assert 1 < len(naming) <= NAMING_A_KIND, naming


def downcasts() -> Iterator[str]:
    for path in [p for room in ("engine", "input") for p in (PACKAGE / room).rglob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            name = path.relative_to(ROOT)
            if isinstance(node, ast.Assert) and "isinstance" in ast.unparse(node.test):
                yield f"{name}:{node.lineno}: assert isinstance"
            if isinstance(node, ast.ClassDef) and "runtime_checkable" in map(ast.unparse, node.decorator_list):
                yield f"{name}:{node.lineno}: runtime_checkable"


def test_nothing_is_asked_for_its_class_to_be_used_as_such() -> None:
    found = list(downcasts())
    assert len(found) <= DOWNCASTS, found


def test_the_formatter_lays_out_all_but_tables() -> None:
    folders = ("gsstream", "plugins", "tests", "tools")
    files = [path for folder in folders for path in (ROOT / folder).rglob("*.py") if "build" not in path.parts]
    skips = sum(path.read_text(encoding="utf-8").count("# fmt: " + "skip") for path in [*files, ROOT / "conftest.py"])
    assert 0 < skips <= TABLES
