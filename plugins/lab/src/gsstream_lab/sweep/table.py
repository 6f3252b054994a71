"""The table of a sweep: one file, only ever appended to, one JSON object a line.

Kinds of lines (``record``): ``plan`` (config, points; the last one counts), ``machine`` and ``recipe`` (stored once, by
id), ``first_frame`` and ``cell`` (status done or failed; the last line of an id counts).
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gsstream.core.errors import InputError, OutputError

TABLE = "table.jsonl"
FORMAT = "1.0"


@dataclass(frozen=True, slots=True)
class TableData:
    """What a table holds, by kind and id."""

    plan: Mapping[str, Any] | None = None
    machines: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    recipes: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    first_frames: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    cells: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def done(self) -> set[str]:
        """Return the ids of cells that need not run again."""
        return {key for key, row in self.cells.items() if row["status"] == "done"}


def read_table(path: Path) -> TableData:
    """Read a table (or the folder that holds it).

    A last line without its end is what a kill left behind: passed over. Raises InputError naming file and line for
    anything else that is not a record, and when there is no table.
    """
    path = path / TABLE if path.is_dir() else path
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"cannot read {path}: {error}; expected the table of a sweep (gsstream sweep)") from error
    kept = text[: text.rfind("\n") + 1]
    plan: Mapping[str, Any] | None = None
    found: dict[str, dict[str, Mapping[str, Any]]] = {"machine": {}, "recipe": {}, "first_frame": {}, "cell": {}}
    for number, row in _rows(kept, path):
        kind = row.get("record")
        if kind == "plan" and isinstance(row.get("points"), list):
            plan = row
        elif kind in found and isinstance(row.get("id"), str):
            found[str(kind)][row["id"]] = row
        else:
            raise InputError(f"{path}:{number}: expected a record of a sweep with an id, got {str(row)[:80]}")
    return TableData(
        plan=plan,
        machines=found["machine"],
        recipes=found["recipe"],
        first_frames=found["first_frame"],
        cells=found["cell"],
    )


def _rows(text: str, path: Path) -> Iterator[tuple[int, Mapping[str, Any]]]:
    for number, line in enumerate(text.splitlines(), 1):
        try:
            row = json.loads(line)
        except ValueError as error:
            raise InputError(f"{path}:{number}: not a line of a sweep's table: {error}") from error
        if not isinstance(row, dict):
            raise InputError(f"{path}:{number}: expected a JSON object, got {line[:40]!r}")
        yield number, row


class TableWriter:
    """Appends records; one writer at a time (see ``lock.held``). Each line is on disk before the next one."""

    def __init__(self, out: Path) -> None:
        self._path = out / TABLE
        if self._path.exists():
            self._cut_unfinished_line()
            self.data = read_table(self._path)
        else:
            self.data = TableData()
        self._known = {*self.data.machines, *self.data.recipes}

    def _cut_unfinished_line(self) -> None:
        content = self._path.read_bytes()
        end = content.rfind(b"\n") + 1
        if end < len(content):
            with self._path.open("r+b") as file:
                file.truncate(end)

    def append(self, record: str, values: Mapping[str, Any]) -> None:
        """Append one record. Raises OutputError when the disk does not take it."""
        line = json.dumps({"record": record, **values}, separators=(",", ":"), allow_nan=False)
        try:
            with self._path.open("a", encoding="utf-8") as file:
                file.write(line + "\n")
                file.flush()
        except OSError as error:
            raise OutputError(f"cannot write {self._path}: {error.strerror}; free some space and go on") from error

    def append_once(self, record: str, key: str, values: Mapping[str, Any]) -> None:
        """Append a machine or a recipe unless the table has it."""
        if key not in self._known:
            self.append(record, {"id": key, **values})
            self._known.add(key)
