"""What a run wrote down: ``metrics.jsonl``, one JSON object per frame."""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gsstream.core.errors import InputError
from gsstream.engine.run.metrics_log import read_metrics


@dataclass(frozen=True, slots=True)
class FrameRecord:
    """One frame of a run. Quantities that were not measured are empty or nan."""

    frame: int  # frame index
    #: psnr, ssim, psnr_moving, psnr_changed: test camera -> value (dB, SSIM 1); cameras where nothing moves, or
    #: changes, are left out of the last two.
    psnr: Mapping[str, float] = field(default_factory=dict)
    ssim: Mapping[str, float] = field(default_factory=dict)
    psnr_moving: Mapping[str, float] = field(default_factory=dict)
    bytes: Mapping[str, int] = field(default_factory=dict)  # packet section -> bytes, headers included
    seconds: Mapping[str, float] = field(default_factory=dict)  # phase -> wall seconds
    #: sent_gaussians, num_gaussians, active_gates, num_gates: counts.
    sent_gaussians: int = 0
    num_gaussians: int = 0
    active_gates: int = 0
    num_gates: int = 0
    peak_memory_mb: float = math.nan  # peak resident memory so far, MB
    psnr_changed: Mapping[str, float] = field(default_factory=dict)
    open_gates: tuple[int, ...] = ()  # after each epoch of the frame

    @property
    def is_key(self) -> bool:
        """Only key packets carry a layout."""
        return "layout" in self.bytes

    @property
    def total_bytes(self) -> int:
        return sum(self.bytes.values())


def mean(values: Iterable[float]) -> float:
    """Return the mean of the finite values; nan when there are none."""
    kept = [v for v in values if math.isfinite(v)]
    return sum(kept) / len(kept) if kept else math.nan


def mean_of_views(frames: Iterable[Mapping[str, Any]], name: str) -> float:
    """Return the mean of a quantity of ``metrics.jsonl`` over cameras, then over frames; nan: not measured."""
    return mean(mean(v for v in (frame.get(name) or {}).values() if v is not None) for frame in frames)


def finite_or_none(value: Any) -> Any:
    """Return a value as JSON holds it: None for a number that is not finite."""
    return None if isinstance(value, float) and not math.isfinite(value) else value


def read_records(path: str | os.PathLike[str]) -> list[FrameRecord]:
    """Read ``metrics.jsonl`` (or its folder) in the order of frames; the last entry of a frame counts.

    Unknown entries are passed over. Raises InputError naming file and line, and when there is no frame.
    """
    path = Path(path)
    path = path / "metrics.jsonl" if path.is_dir() else path
    found: dict[int, FrameRecord] = {}
    for number, line in read_metrics(path):
        try:
            record = record_of(line)
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            raise InputError(f"{path}:{number}: not a frame record: {error!r}") from error
        found[record.frame] = record
    if not found:
        raise InputError(f"{path} holds no frame record")
    return [found[frame] for frame in sorted(found)]


def read_lines(path: Path) -> list[dict[str, Any]]:
    """Read the lines of a ``metrics.jsonl`` as they are, in the order of frames; the last entry of a frame counts.

    Raises InputError as ``engine.run.metrics_log.read_metrics``.
    """
    found = {line["frame"]: line for _, line in read_metrics(path)}
    return [found[frame] for frame in sorted(found)]


def record_of(data: Mapping[str, Any]) -> FrameRecord:
    """Read one line of ``metrics.jsonl``; raises ValueError, TypeError, KeyError or AttributeError."""
    memory = data.get("peak_memory_mb")
    return FrameRecord(
        frame=int(data["frame"]),
        psnr=_numbers(data.get("psnr")),
        ssim=_numbers(data.get("ssim")),
        psnr_moving=_numbers(data.get("psnr_moving")),
        bytes={name: int(v) for name, v in _numbers(data.get("bytes")).items()},
        seconds=_numbers(data.get("seconds")),
        sent_gaussians=int(data.get("sent_gaussians") or 0),
        num_gaussians=int(data.get("num_gaussians") or 0),
        active_gates=int(data.get("active_gates") or 0),
        num_gates=int(data.get("num_gates") or 0),
        peak_memory_mb=math.nan if memory is None else float(memory),
        psnr_changed=_numbers(data.get("psnr_changed")),
        open_gates=tuple(int(number) for number in data.get("open_gates") or ()),
    )


def _numbers(table: Mapping[str, Any] | None) -> dict[str, float]:
    return {str(name): float(value) for name, value in (table or {}).items() if value is not None}
