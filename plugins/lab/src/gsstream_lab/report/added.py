"""Rows of other programs: what ``gsstream evaluate --json`` or ``evaluate-files --json`` wrote, beside ours."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsstream.core.errors import InputError
from gsstream.evaluation.records import mean
from gsstream_lab.report.document import Block, Table
from gsstream_lab.report.groups import SweepData
from gsstream_lab.report.quantities import BY_KEY, cell

#: Quantities that both have, by the same keys: means over cameras, then over the frames after the first.
SHARED = ("psnr", "psnr_moving", "psnr_changed", "psnr_seen", "psnr_changed_seen", "ssim", "lpips")


@dataclass(frozen=True, slots=True)
class Added:
    """One evaluation."""

    name: str
    cameras: frozenset[str]
    frames: tuple[int, ...]
    values: dict[str, float]  # quantity -> number, nan where it was not measured
    drawn_by: str


def read_added(text: str) -> Added:
    """Read ``FILE`` or ``NAME=FILE``. Raises InputError for a file that is not the JSON of an evaluation."""
    name, separator, file = text.rpartition("=")
    path = Path(file)
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        views: list[dict[str, Any]] = data["views"]
        frames = tuple(sorted({int(view["frame"]) for view in views}))
        values = {"psnr_first": _of(views, "psnr", frames[:1])}
        values |= {key: _of(views, key, frames[1:]) for key in SHARED}
        cameras = frozenset(str(view["camera"]) for view in views)
        return Added(name if separator else path.stem, cameras, frames, values, str(data["renderer"]))
    except OSError as error:
        raise InputError(f"--add {text}: cannot read {path}: {error.strerror}") from error
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise InputError(
            f"--add {text}: expected what 'gsstream evaluate --json' or 'gsstream evaluate-files --json' writes, got "
            f"{path} ({type(error).__name__}: {error})"
        ) from error


def _of(views: Sequence[dict[str, Any]], key: str, frames: Sequence[int]) -> float:
    per_frame = ([float(v[key]) for v in views if v["frame"] == t and v.get(key) is not None] for t in frames)
    return mean(mean(values) for values in per_frame)


def beside(data: SweepData, added: Sequence[Added]) -> list[Block]:
    """Return a table for each scene that shows the added rows' test cameras.

    Raises InputError for a row whose cameras or frames are those of no scene: it would be compared with another thing.
    """
    blocks: list[Block] = []
    fitting: set[str] = set()
    for scene in data.scenes:
        groups = data.of(scene)
        records = groups[0].runs[0].records
        cameras, frames = frozenset(records[0].psnr), tuple(record.frame for record in records)
        here = [row for row in added if (row.cameras, row.frames) == (cameras, frames)]
        if not here:
            continue
        fitting |= {row.name for row in here}
        keys = ["psnr_first", *(key for key in SHARED if any(math.isfinite(row.values[key]) for row in here))]
        rows = [["", *(BY_KEY[key].title for key in keys), "drawn by"]]
        rows += [[group.label, *(cell(key, group.mean(key)) for key in keys), "the player"] for group in groups]
        rows += [[f"{row.name} (added)", *(cell(key, row.values[key]) for key in keys), row.drawn_by] for row in here]
        blocks += [f"## {scene}, beside other programs", Table("Added rows are not of this sweep", rows)]
    for row in added:
        if row.name not in fitting:
            raise InputError(
                f"--add {row.name}: it has the test cameras {', '.join(sorted(row.cameras))} and "
                f"{len(row.frames)} frames from {row.frames[0]}; expected those of a scene of this sweep "
                f"({', '.join(data.scenes)})"
            )
    return blocks
