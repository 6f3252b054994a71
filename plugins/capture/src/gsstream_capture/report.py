"""What a capture did."""

from __future__ import annotations

from dataclasses import dataclass, field
from statistics import median


@dataclass
class Report:
    """What a capture did."""

    frames: int = 0
    whole: int = 0
    dropped: int = 0  # instants, because too many waited
    disk: int = 0  # instants, because the disk was full
    ended: str = ""  # why, where nobody asked for it
    absent: dict[str, int] = field(default_factory=dict)
    delays: list[float] = field(default_factory=list)  # seconds from an instant to its files, the last 10,000


def summary(report: Report) -> str:
    """Return what a capture did, in lines."""
    lines = [f"{report.frames} instants, {report.whole} of them of all cameras"]
    if report.delays:
        lines[0] += f"; from the instant to its files {1000 * median(report.delays):.0f} ms (median)"
    lines += [f"{name}: absent in {count}" for name, count in report.absent.items() if count]
    if report.dropped:
        lines.append(f"{report.dropped} instants dropped: this machine was too busy; lower fps or the resolution")
    if report.disk:
        lines.append(f"{report.disk} instants dropped: less than 1 GB of the disk is free")
    return "\n".join(lines)
