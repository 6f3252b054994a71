"""What a stream shows of surfaces that training cameras see, for the results pages."""

from __future__ import annotations

import json
import statistics
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path


def seen_numbers(stream: Path, frames: Sequence[int]) -> dict[str, float]:
    """Return PSNR, dB, on pixels whose surface training cameras see, and on those that changed; decodes the stream.

    Means over the frames after the first, and of each of ``frames`` what changed and is seen.
    """
    command = ["gsstream", "evaluate", str(stream), "--json"]
    found = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)["views"]

    def mean(key: str, wanted: Callable[[int], bool]) -> float:
        values = [view[key] for view in found if wanted(view["frame"]) and view[key] is not None]
        return float(f"{statistics.fmean(values):.6g}")

    first = found[0]["frame"]
    numbers = {key: mean(key, lambda frame: frame != first) for key in ("psnr_seen", "psnr_changed_seen")}
    return numbers | {f"frame_{frame}": mean("psnr_changed_seen", frame.__eq__) for frame in frames}
