"""A sweep's table -> groups: the runs of one point with all its seeds, their means, and the noise between seeds."""

from __future__ import annotations

import json
import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gsstream.core.errors import InputError
from gsstream.evaluation.records import FrameRecord, record_of
from gsstream_lab.report.quantities import QUANTITIES, spread, values_of
from gsstream_lab.sweep.table import TableData, read_table


@dataclass(frozen=True, slots=True)
class Run:
    """One finished cell: its record, frames and numbers."""

    id: str
    seed: int
    row: Mapping[str, Any]
    records: tuple[FrameRecord, ...]
    values: Mapping[str, float]


@dataclass(frozen=True, slots=True)
class Group:
    """All finished seeds of a point."""

    #: scene, variant, axes: of the point.
    scene: str
    variant: str
    axes: Mapping[str, Any]
    runs: tuple[Run, ...]  # one for each seed
    #: Key of an axis -> the word for it in labels; for others the last word of the key.
    words: Mapping[str, str] = field(default_factory=dict)

    @property
    def label(self) -> str:
        """``edge`` or ``edge epochs=3``."""
        named = (f"{self.words.get(key, _last_word(key))}={_short(value)}" for key, value in self.axes.items())
        return " ".join([self.variant, *named])

    def mean(self, key: str) -> float:
        """Return the mean over seeds; nan when a seed did not measure it."""
        return statistics.fmean(run.values[key] for run in self.runs)

    def spread(self, key: str) -> float:
        """Return the standard deviation over seeds; nan with a single one."""
        return spread([run.values[key] for run in self.runs])


@dataclass(frozen=True, slots=True)
class SweepData:
    """What a report is made from: finished groups in the order of the plan, labels of failed and missing cells."""

    config: Mapping[str, Any]
    groups: tuple[Group, ...]
    failed: Mapping[str, str]
    missing: tuple[str, ...]
    table: TableData

    @property
    def scenes(self) -> list[str]:
        """Scenes with a finished run, in the order of the plan."""
        return list(dict.fromkeys(group.scene for group in self.groups))

    def of(self, scene: str) -> list[Group]:
        """Return the groups of a scene."""
        return [group for group in self.groups if group.scene == scene]

    def measured(self) -> list[str]:
        """Return the keys of quantities that at least one group has."""
        return [q.key for q in QUANTITIES if any(math.isfinite(group.mean(q.key)) for group in self.groups)]


def read_sweep_data(folder: Path) -> SweepData:
    """Read a sweep's folder. Raises InputError when it holds no plan or no finished cell."""
    table = read_table(folder)
    if table.plan is None:
        raise InputError(f"{folder}: the table holds no plan; expected the folder of 'gsstream sweep'")
    words = _words({key for point in table.plan["points"] for key in point["axes"]})
    found: dict[str, list[tuple[Mapping[str, Any], Run]]] = {}
    failed, missing = {}, []
    for point in table.plan["points"]:
        row = table.cells.get(point["cell"])
        key = json.dumps([point["scene"], point["variant"], point["axes"]])
        if row is None or row["status"] != "done":
            group = Group(scene=point["scene"], variant=point["variant"], axes=point["axes"], runs=(), words=words)
            label = f"{group.label} seed {point['seed']}"
            if row is None:
                missing.append(f"{point['scene']} {label}")
            else:
                failed[f"{point['scene']} {label}"] = row["error"]
            continue
        row = {**row, "first_seconds": _first_seconds(row, table)}
        records = tuple(record_of(frame) for frame in row["frames"])
        run = Run(id=point["cell"], seed=point["seed"], row=row, records=records, values=values_of(records, row))
        found.setdefault(key, []).append((point, run))
    if not found:
        raise InputError(f"{folder}: no cell has finished yet ({len(failed)} failed); nothing to report")
    groups = tuple(
        Group(
            scene=items[0][0]["scene"],
            variant=items[0][0]["variant"],
            axes=items[0][0]["axes"],
            runs=tuple(run for _, run in items),
            words=words,
        )
        for items in found.values()
    )
    return SweepData(config=table.plan["config"], groups=groups, failed=failed, missing=tuple(missing), table=table)


def _first_seconds(row: Mapping[str, Any], table: TableData) -> float | None:
    """Seconds of the frame 0 of a cell: of the run that made it, where it is shared; None: it was given (``tune``)."""
    made = row if row.get("first_frame") is None else table.first_frames.get(row["first_frame"])
    if made is None or made["status"] != "done" or not made["frames"]:
        return None
    return float(sum(made["frames"][0]["seconds"].values()))


def waited(groups: Sequence[Group]) -> bool:
    """Say whether the runs waited for the processor: frames took over 1.5 times what their threads account for."""
    shares = []
    for run in (run for group in groups for run in group.runs):
        cpu, threads = run.values["cpu_seconds"], float(run.row.get("threads") or math.nan)
        if cpu > 0 and threads == 1:
            shares.append(run.values["seconds"] / cpu)
    return bool(shares) and statistics.median(shares) > 1.5


def seed_noise(groups: Sequence[Group], key: str) -> float:
    """Return the standard deviation between seeds of one point, pooled over all points with several.

    It is nan when there is none.
    """
    parts = [(len(group.runs) - 1, group.spread(key)) for group in groups]
    known = [(freedom, spread) for freedom, spread in parts if math.isfinite(spread)]
    freedom = sum(f for f, _ in known)
    return math.sqrt(sum(f * spread**2 for f, spread in known) / freedom) if freedom else math.nan


def is_tie(first: Group, second: Group, key: str, noise: float) -> bool | None:
    """Say whether two means differ by no more than two standard errors of their difference; None: noise unknown."""
    if not math.isfinite(noise):
        return None
    error = noise * math.sqrt(1 / len(first.runs) + 1 / len(second.runs))
    return abs(first.mean(key) - second.mean(key)) <= 2 * error


def _words(keys: Iterable[str]) -> dict[str, str]:
    """Words for axes in labels: the last word of a key; the whole key where two axes end alike."""
    known = sorted(keys)
    last = [_last_word(key) for key in known]
    return {key: word if last.count(word) == 1 else key for key, word in zip(known, last, strict=True)}


def _last_word(key: str) -> str:
    return key.rpartition(".")[2]


def _short(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)
