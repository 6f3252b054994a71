"""What a soak came to: counts, failures, and whether the memory stayed flat."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from statistics import median
from typing import Any

#: Most growth of the resident size, last third against first.
MOST_GROWTH = 0.05


def summarise(runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """The numbers of a table.

    ``memory``: medians of the resident size after each run, first, second and last third of the longest process;
    ``longest_clean``: most cases in a row, and their hours, without a failure.
    """
    status = Counter(run["outcome"]["status"] for run in runs)
    done = [run for run in runs if run["outcome"]["status"] == "ok"]
    failures = [run for run in runs if run["outcome"]["status"] not in ("ok", "refused")]
    memory = _memory(runs)
    return {
        "clean": not failures and memory["growth"] <= MOST_GROWTH,
        "cases": len(runs),
        **dict(status),
        "recipes": len({run["command"].partition(" --method ")[2] for run in done}),
        "frames": sum(run["outcome"]["frames"] for run in done),
        "packets": dict(sum((Counter(run["outcome"]["kinds"]) for run in done), Counter())),
        "methods": dict(Counter(run["method"] for run in done)),
        "most_gaussians": max((run["outcome"]["gaussians"] for run in done), default=0),
        "failures": Counter(run["outcome"]["problem"].partition("\n")[0] for run in failures).most_common(),
        "failed_cases": [run["index"] for run in failures],
        "longest_clean": _longest_clean(runs),
        "memory": memory,
    }


def _memory(runs: Sequence[dict[str, Any]]) -> dict[str, float]:
    processes = Counter(run["process"] for run in runs)
    longest = processes.most_common(1)[0][0]
    sizes = [run["rss_mb"] for run in runs if run["process"] == longest and "rss_mb" in run]
    if not sizes:
        return {"growth": 0.0, "runs": 0}
    third = max(1, len(sizes) // 3)
    parts = {"first": sizes[:third], "middle": sizes[third : 2 * third] or sizes, "last": sizes[-third:]}
    medians = {f"{name}_third_mb": round(median(part), 1) for name, part in parts.items()}
    growth = median(parts["last"]) / median(parts["first"]) - 1
    return {**medians, "growth": round(growth, 4), "most_mb": round(max(sizes), 1), "runs": len(sizes)}


def _longest_clean(runs: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Cases, frames and minutes of the longest stretch between two failures."""
    best: list[dict[str, Any]] = []
    stretch: list[dict[str, Any]] = []
    for run in runs:
        stretch = [*stretch, run] if run["outcome"]["status"] in ("ok", "refused") else []
        best = max(best, stretch, key=len)
    minutes = (best[-1]["time"] - best[0]["time"]) / 60 if best else 0.0
    frames = sum(run["outcome"]["frames"] for run in best)
    return {"cases": len(best), "frames": frames, "minutes": round(minutes, 1)}
