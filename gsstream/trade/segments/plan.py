"""Which frames belong to which segment, and what has to be there before a segment can begin."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from gsstream.core.errors import InputError, OutputError
from gsstream.packet import StreamReader

Start = Literal["warm", "open", "anew"]
PLAN = "segments.json"
STREAM = "stream.gss"
#: The shortest segment: a key packet and one frame that goes on from it.
LEAST = 2


@dataclass(frozen=True, slots=True)
class Task:
    """One run of the engine.

    Arguments:
        id: name of its folder below the output folder.
        frames: what it encodes; the first of them is a key packet.
        after: the task whose last frame it starts from; None: it reconstructs its first frame.
        shown: frame whose pictures stand in for the first of ``frames``, for a task that only carries a scene from one
            key frame to the next; None: the frame's own.
    """

    id: str
    frames: range
    after: str | None = None
    shown: int | None = None

    def done(self, out: Path) -> bool:
        """Say whether its stream is there whole."""
        path = out / self.id / STREAM
        if not path.is_file() or path.stat().st_size == 0:
            return False
        with StreamReader(path) as reader:
            return reader.damage is None and [entry.frame for entry in reader.frames] == list(self.frames)


@dataclass(frozen=True, slots=True)
class SegmentPlan:
    """All tasks of a run, in the order in which they are worth starting; ``segments`` are joined in their order."""

    keys: tuple[Task, ...]
    segments: tuple[Task, ...]

    @property
    def seams(self) -> list[int]:
        """Frames at which a segment other than the first begins."""
        return [task.frames.start for task in self.segments[1:]]


def make_plan(frames: int, segments: int, start: Start, *, first_given: bool) -> SegmentPlan:
    """Cut ``frames`` frames into ``segments`` of nearly equal length.

    Arguments:
        frames: of the recording.
        segments: how many.
        start: "warm": the scene of a segment's first frame is that of the segment before, carried over in one step;
            "open": so, too (the two differ in the recipe of that step, ``carry``); "anew": it is reconstructed.
        first_given: frame 0 is taken over from another stream.

    Raises InputError when segments would be shorter than two frames.
    """
    if segments < 1 or frames < LEAST * segments:
        raise InputError(
            f"--segments {segments}: a segment has at least {LEAST} frames, the recording has {frames}; expected 1 to "
            f"{max(1, frames // LEAST)}"
        )
    bounds = [frames * k // segments for k in range(segments + 1)]
    starts = bounds[:-1]
    keys = [] if first_given else [Task("key-000", range(0, 1))]
    for k in range(1, segments):
        before = f"key-{k - 1:03d}" if k > 1 or not first_given else "first"
        if start == "anew":
            keys.append(Task(f"key-{k:03d}", range(starts[k], starts[k] + 1)))
        else:
            # A leap encodes two frames: the last key frame, as if it were the frame before, and this key frame.
            keys.append(Task(f"key-{k:03d}", range(starts[k] - 1, starts[k] + 1), before, starts[k - 1]))
    parts = [
        Task(f"segment-{k:03d}", range(starts[k], bounds[k + 1]), f"key-{k:03d}" if k or not first_given else "first")
        for k in range(segments)
    ]
    return SegmentPlan(tuple(keys), tuple(parts))


def write_plan(out: Path, facts: Mapping[str, Any], *, resume: bool) -> None:
    """Leave in ``out`` what is being made there; to go on, it must be the same.

    Arguments:
        out: folder of the run.
        facts: that must be the same to go on.
        resume: go on with what is there.

    Raises OutputError when it is not.
    """
    path = out / PLAN
    if resume:
        try:
            before = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, json.JSONDecodeError) as error:
            raise OutputError(f"nothing to resume: {path} cannot be read ({error}); leave --resume out") from error
        changed = [key for key in facts if before.get(key) != facts[key]]
        if changed:
            raise OutputError(
                f"{out} was begun with other settings: {', '.join(changed)} differ; resume with the same, or start "
                "again with --overwrite"
            )
        return
    path.write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
