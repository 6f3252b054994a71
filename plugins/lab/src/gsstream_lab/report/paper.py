"""The paper's tables, from ``paper.yaml``: its numbers beside ours, labelled with recording and machine."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

from ruamel.yaml import YAML

from gsstream.core.errors import UnknownName
from gsstream_lab.report.document import Table
from gsstream_lab.report.groups import Group
from gsstream_lab.report.quantities import BY_KEY, cell

_FILE = Path(__file__).with_name("paper.yaml")


@dataclass(frozen=True, slots=True)
class PaperTable:
    """A table as printed: row name -> quantity -> value, nan where it prints none."""

    name: str
    title: str
    data: str
    machine: str
    source: str
    columns: tuple[str, ...]
    rows: Mapping[str, Mapping[str, float]]


def paper_table(name: str) -> PaperTable:
    """Return a table of the paper by its name. Raises UnknownName, naming the nearest."""
    content: Mapping[str, Any] = YAML(typ="safe", pure=True).load(_FILE.read_text(encoding="utf-8"))
    if name not in content["tables"]:
        raise UnknownName("table of the paper", name, content["tables"])
    table = content["tables"][name]
    columns = tuple(table["columns"])
    rows = {
        str(row): {key: math.nan if v is None else float(v) for key, v in zip(columns, values, strict=True)}
        for row, values in table["rows"].items()
    }
    machine = table.get("machine", content["machine"])
    return PaperTable(
        name=name,
        title=table["title"],
        data=table["data"],
        machine=machine,
        source=content["source"],
        columns=columns,
        rows=rows,
    )


def beside_ours(
    table: PaperTable, groups: Sequence[Group], scene: str, variants: Mapping[str, str] = MappingProxyType({})
) -> Table:
    """Return the paper's rows, each followed by our run in the same columns.

    Moving pixels and processor seconds of our run stand behind them.
    """
    ours = {group.variant: group for group in groups if not group.axes}
    more = [key for key in ("psnr_moving", "cpu_seconds") if any(math.isfinite(g.mean(key)) for g in ours.values())]
    rows = [["", "whose", "seeds", *(BY_KEY[key].title for key in (*table.columns, *more))]]
    for name, values in table.rows.items():
        rows.append([name, "paper", "", *(_printed(key, values[key]) for key in table.columns), *("-" for _ in more)])
        group = ours.get(variants.get(name, name))
        if group is not None:
            cells = [cell(key, group.mean(key), group.spread(key)) for key in (*table.columns, *more)]
            rows.append(["", f"ours, {scene}", str(len(group.runs)), *cells])
    caption = f"{table.title}: the paper on {table.data}, {table.machine} ({table.source})"
    return Table(f"{caption}; ours on {scene}, machine above, frames after the first", rows)


def _printed(key: str, value: float) -> str:
    return "-" if not math.isfinite(value) else cell(key, value)
