"""How far a run lags behind the cameras of a recording that is still being written, and what its policies cost."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from statistics import median
from typing import Any

from gsstream.core.frame import Arrival, Frame
from gsstream.input.recordings.base import Moment

#: Policy -> its words in the summary and in the line of a frame.
COUNTED: Mapping[str, str] = {
    "dropped": "{} dropped because the run was behind",
    "missing": "{} dropped because a camera's image did not come",
    "hurried": "{} hurried",
    "held": "{} with held images",
}
_WORDS: Mapping[str, str] = {
    "dropped": "dropped",
    "missing": "dropped: a camera is missing",
    "hurried": "hurried",
    "held": "an image is held",
}


def live_metrics(frame: Frame, written: float) -> dict[str, Any] | None:
    """Return the entry ``live`` of a frame's metrics; None for a recording that is not live.

    The latency runs from the moment when the last image was complete to that when the packet was. It is None when the
    files were gone by then, and negative where the clock that dates the images is ahead.
    """
    arrival = frame.arrival
    if arrival is None:
        return None
    latency = None if arrival.complete is None else written - arrival.complete
    return {
        "latency_seconds": latency,
        "policy": _policy(frame),
        "epoch_scale": frame.epoch_scale,
        "absent": list(arrival.absent),
        "waiting": arrival.waiting,
    }


def past_moments(lines: Iterable[Mapping[str, Any]]) -> dict[int, Moment]:
    """Frame -> how it came in, of those frames of a live recording that have a line of ``metrics.jsonl``."""
    live = {int(line["frame"]): line["live"] for line in lines if line.get("live") is not None}
    return {
        frame: Moment(entry["epoch_scale"], Arrival(None, tuple(entry["absent"]), entry.get("waiting", 0)))
        for frame, entry in live.items()
    }


def _policy(frame: Frame) -> str | None:
    """Name of the most drastic policy for a frame: one that is dropped is neither hurried nor held."""
    if frame.index == 0:
        return None  # always done in full, of every camera
    absent = bool(frame.arrival and frame.arrival.absent)
    if frame.epoch_scale == 0:
        return "missing" if absent else "dropped"
    return "hurried" if frame.epoch_scale < 1 else "held" if absent else None


def latency_words(metrics: Mapping[str, Any]) -> list[str]:
    """Return the latency of a frame for its line of metrics; empty for a recording that is not live."""
    live = metrics.get("live")
    if live is None:
        return []
    latency = live["latency_seconds"]
    words = ["latency unknown" if latency is None else f"{latency:.2f} s late"]
    return words if live["policy"] is None else [*words, _WORDS[live["policy"]]]


def latency_lines(lines: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the lines on latency in the summary of a run; empty for a recording that was not live.

    A dropped frame has a latency in its metrics, but it shows nothing new: median and worst are of the others.
    """
    live = {line["frame"]: line["live"] for line in lines if line.get("live") is not None}
    if not live:
        return []
    known = {frame: entry["latency_seconds"] for frame, entry in live.items() if entry["latency_seconds"] is not None}
    shown = {frame: known[frame] for frame in known if frame and live[frame]["policy"] not in ("dropped", "missing")}
    parts = [f"frame 0 {known[0]:.2f} s"] if 0 in known else []
    if shown:
        worst = max(shown, key=lambda frame: shown[frame])
        parts.append(f"later frames: median {median(shown.values()):.2f} s, worst {shown[worst]:.2f} s (frame {worst})")
    out = ["latency from image to packet: " + ("; ".join(parts) or "unknown, the images were gone")]
    later = [entry["policy"] for frame, entry in live.items() if frame]
    done = [form.format(later.count(name)) for name, form in COUNTED.items() if name in later]
    if later:
        out.append(f"of {len(later)} later frames: " + (", ".join(done) or "none was dropped, hurried or held"))
    if "dropped" in later:
        out.append("frames dropped by a run that was behind are not measured above; gsstream evaluate measures all")
    return out
