"""What a budget did to a run, in plain lines: frames inside, what bound, what was given up, every violation."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any

_UNITS = {"time": (1.0, "s", "{:.2f}"), "size": (1e-3, "KB", "{:.2f}"), "memory": (1e-6, "MB", "{:.0f}")}
#: Violations that are listed one by one; the rest is counted (metrics.jsonl has them all).
LISTED = 20


def quantity(name: str, value: float) -> str:
    """Return a number with its unit: ``19.80 KB``."""
    factor, unit, form = _UNITS[name]
    return f"{form.format(factor * value)} {unit}"


def violations(metrics: Mapping[str, Any]) -> list[str]:
    """Return ``size 21.3 KB of 20.0 KB`` for every limit that a frame broke."""
    entry = metrics.get("budget", {})
    return [
        f"{name} {quantity(name, entry['actual'][name])} of {quantity(name, entry['limits'][name])}"
        for name in entry.get("violated", ())
    ]


def budget_lines(lines: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the budget's part of a run's summary; empty for a run without one."""
    held = [line for line in lines if line.get("budget", {}).get("limits")]
    if not held:
        return []
    out = []
    names = [name for name in _UNITS if any(name in line["budget"]["limits"] for line in held)]
    for name in names:
        of = [line["budget"] for line in held if name in line["budget"]["limits"]]
        limit, actual = of[-1]["limits"][name], [entry["actual"][name] for entry in of]
        inside = sum(name not in entry["violated"] for entry in of)
        binding = sum(name in entry.get("binding", ()) for entry in of)
        text = f"budget {name} {quantity(name, limit)}: {inside} of {len(of)} frames inside; "
        text += f"median {quantity(name, median(actual))}, most {quantity(name, max(actual))}"
        out.append(text if name == "memory" else f"{text}; it bound {binding} frames")
    out += _reductions(held)
    broken = [f"  frame {line['frame']}: {', '.join(violations(line))}" for line in held if line["budget"]["violated"]]
    if broken:
        out += ["outside the budget:", *broken[:LISTED]]
        out += [f"  and {len(broken) - LISTED} more (metrics.jsonl)"] if len(broken) > LISTED else []
    postponed = [line["frame"] for line in held if "key_postponed" in line]
    if postponed:
        frames = f"frames {postponed[0]} to {postponed[-1]}" if len(postponed) > 1 else f"frame {postponed[0]}"
        out.append(f"a key packet was due and postponed in {len(postponed)} frames ({frames}): {_reason(held)}")
    return out


def _reductions(held: Sequence[Mapping[str, Any]]) -> list[str]:
    """What the budget reduced, by kind: in how many frames, and the median of how much."""
    found: dict[str, list[float]] = {}
    for line in held:
        for name, value in line["budget"].get("reduced", {}).items():
            found.setdefault(name, []).append(value[1] if isinstance(value, list) else value)
    words = {
        "rd_lambda": "rate weight raised to {:.1e}", "step_scale": "steps {:.1f} times coarser",
        "symbols": "{:.0f} symbols trimmed", "gates": "{:.0f} gates closed", "added": "{:.0f} added Gaussians dropped",
        "epochs": "{:.1f} passes less than the recipe's", "part_scale": "{:.2f} of the passes of motion and growth",
        "change_threshold": "change threshold raised to {:.1f}",
    }  # fmt: skip
    parts = [f"{words[name].format(median(v))} (median of {len(v)} frames)" for name, v in found.items()]
    return ["given up: " + "; ".join(parts)] if parts else []


def _reason(held: Sequence[Mapping[str, Any]]) -> str:
    return str(next(line["key_postponed"] for line in reversed(held) if "key_postponed" in line))
