"""What every benchmark shares: timings, interleaving, cells of its tables, JSON on disk."""

from __future__ import annotations

import json
import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from gsstream.core.errors import OutputError

Progress = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Timing:
    """Milliseconds of several repetitions: that passed, and of processor time over all threads."""

    samples: tuple[float, ...]
    cpu: tuple[float, ...]

    def __add__(self, other: Timing) -> Timing:
        """Repetition by repetition."""
        both = ((self.samples, other.samples), (self.cpu, other.cpu))
        samples, cpu = (tuple(a + b for a, b in zip(*pair, strict=True)) for pair in both)
        return Timing(samples, cpu)

    @property
    def minimum(self) -> float:
        return min(self.samples)

    @property
    def median(self) -> float:
        return statistics.median(self.samples)

    def to_json(self) -> dict[str, float]:
        """Return least and median, and the least processor time, ms."""
        return {"min": round(self.minimum, 5), "median": round(self.median, 5), "cpu": round(min(self.cpu), 5)}


@dataclass(frozen=True, slots=True)
class Steps:
    """Something to time: steps that follow each other, by name; ``prepare`` runs before them, untimed."""

    steps: Mapping[str, Callable[[], object]]
    prepare: Callable[[], object] = lambda: None


def interleaved(cases: Sequence[Steps], repetitions: int, warm_up: int) -> list[dict[str, Timing]]:
    """Time all cases in turn, ``repetitions`` times over: a slow second of the machine falls on all of them alike.

    The first ``warm_up`` rounds are not counted.
    """
    found: list[dict[str, list[tuple[float, float]]]] = [{name: [] for name in case.steps} for case in cases]
    for round_ in range(warm_up + repetitions):
        for case, samples in zip(cases, found, strict=True):
            case.prepare()
            for name, step in case.steps.items():
                started, worked = time.perf_counter(), time.process_time()
                step()
                elapsed, work = time.perf_counter() - started, time.process_time() - worked
                if round_ >= warm_up:
                    samples[name].append((1000 * elapsed, 1000 * work))
    return [{name: Timing(*zip(*values, strict=True)) for name, values in samples.items()} for samples in found]


@contextmanager
def torch_threads(count: int) -> Any:
    """Let torch have this many threads inside the block."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def write_json(path: Path, data: Mapping[str, Any]) -> None:
    """Write a benchmark's data. Raises OutputError when the file cannot be written."""
    try:
        path.write_text(json.dumps(data, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}; choose another --out") from error


def check_writable(path: Path) -> None:
    """Raise OutputError now rather than after minutes of measuring."""
    if path.is_dir() or not path.parent.is_dir():
        raise OutputError(f"cannot write {path}: expected a file in a folder that exists")


def headline(machine: Mapping[str, Any]) -> str:
    """Return one line about the machine for a Markdown report."""
    gpu = f", {machine['gpu']}" if machine["gpu"] else ""
    load = "" if machine["load_average"] is None else f", load {machine['load_average']:.1f} at the start"
    return f"{machine['date']}, {machine['processor']}, {machine['processors_usable']} processors{gpu}{load}"


def cell(value: float | None, form: str = ".2f") -> str:
    """Return a number for a table; "-" for what was not measured."""
    return "-" if value is None or not math.isfinite(value) else format(value, form)
