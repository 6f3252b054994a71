"""Quantities as text: a number and a unit. Units are decimal (docs/conventions.md): 1 KB = 1,000 bytes."""

from __future__ import annotations

import math
import re

from gsstream.core.errors import suggest

BYTES = {"B": 1.0, "bytes": 1.0, "KB": 1e3, "MB": 1e6, "GB": 1e9}


def read_quantity(text: str, units: dict[str, float]) -> float:
    """Read ``"1.5KB"`` as 1500.0. Raises ValueError that names the nearest unit."""
    match = re.fullmatch(r"\s*([+-]?(?:\d+\.?\d*|\.\d+)(?:e[+-]?\d+)?)\s*([^\s\d.]\S*)?\s*", text)
    if match is None:
        example = "1.5s" if "s" in units else "20KB" if "KB" in units else "2Mbit/s"
        raise ValueError(f"expected a number and a unit ({', '.join(units)}), e.g. {example}")
    unit = match[2]
    if unit is not None and unit not in units:
        near = next((f"; did you mean {name!r}?" for name in units if name.lower() == unit.lower()), None)
        near = near or suggest(unit.replace("i", ""), units).replace("known:", "units here:")
        raise ValueError(f"no unit {unit!r} here{near}")
    value = float(match[1]) * (units[unit] if unit else 1.0)
    if not math.isfinite(value):
        raise ValueError("expected a finite quantity")
    return value
