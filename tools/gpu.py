"""Times of frames on a GPU, replayed and queued, for docs/results/gpu.md.

    python -m tools.gpu SOURCE [KEY=VALUE ...] [--method s2gs-edge] [--frames 6] [--kernels] [--queued]

Prints one JSON object a line: what machine it is, then every frame with its milliseconds by phase, its bytes, and what
was recorded as a CUDA graph: how often, in how many milliseconds, and how often it was replayed. The first later frame
loads libraries; look at those after it. With ``--kernels`` the last frame is profiled, which makes it slower: for how
long the GPU was busy, and the kernels that kept it so. With ``--queued`` the frames are encoded again, operation by
operation. Where there is no GPU nothing is recorded, and operations of the processor stand for kernels.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import torch
from torch.profiler import ProfilerActivity, profile

from gsstream.core.frame import Frame
from gsstream.encode import Encoder, encoder_for, open_recording, recipe_for
from gsstream.parts.render.replay import Records


class Counted:
    """What is recorded and replayed within a frame."""

    def __init__(self) -> None:
        self.made, self.calls = Counter[str](), Counter[str]()
        self.spent: defaultdict[str, float] = defaultdict(float)

    def taken(self) -> dict[str, list[float]]:
        """Return name -> records, milliseconds of recording, replays; begin anew."""
        found = {name: [self.made[name], round(self.spent[name], 1), calls] for name, calls in self.calls.items()}
        self.made.clear()
        self.spent.clear()
        self.calls.clear()
        return found

    @contextmanager
    def watching(self, *, queued: bool) -> Iterator[None]:
        """Count within this context; ``queued``: have nothing recorded."""
        kept = Records.call, Records._record, Records.can
        call, record, _ = kept

        def counted(records: Records, name: str, *args: Any, **kwargs: Any) -> Any:
            self.calls[name] += 1
            return call(records, name, *args, **kwargs)

        def timed(records: Records, name: str, *args: Any, **kwargs: Any) -> Any:
            wait()
            begun = time.perf_counter()
            try:
                return record(records, name, *args, **kwargs)
            finally:
                wait()
                self.made[name] += 1
                self.spent[name] += 1000 * (time.perf_counter() - begun)

        owner: Any = Records
        owner.call, owner._record = counted, timed
        if queued:
            owner.can = lambda *_: False
        try:
            yield
        finally:
            owner.call, owner._record, owner.can = kept


def wait() -> None:
    """Wait until the GPU has done what was queued."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def machine() -> dict[str, Any]:
    """Return the card and what runs on it."""
    card = torch.cuda.get_device_name() if torch.cuda.is_available() else None
    return {"what": "machine", "card": card, "torch": torch.__version__, "cuda": torch.version.cuda}


def encoded(encoder: Encoder, frame: Frame, counted: Counted) -> dict[str, Any]:
    """Return the numbers of one frame."""
    wait()
    begun = time.perf_counter()
    step = encoder.encode(frame)
    wait()
    taken, metrics = 1000 * (time.perf_counter() - begun), step.metrics
    by_phase = {name: round(1000 * seconds, 1) for name, seconds in metrics["seconds"].items()}
    return {
        "what": f"frame {frame.index}, {frame.cameras.width} x {frame.cameras.height}, {len(frame.cameras)} cameras",
        "ms": round(taken, 1),
        "ms_by_phase": by_phase,
        "iterations": metrics.get("iterations"),
        "bytes": len(step.packet.data),
        "records": counted.taken(),
    }


def profiled(work: Callable[[], dict[str, Any]], most: int = 20) -> dict[str, Any]:
    """Return what ``work`` does, for how long its kernels ran, how many they were, and the dearest: ms and number."""
    is_on_gpu = torch.cuda.is_available()
    activity = ProfilerActivity.CUDA if is_on_gpu else ProfilerActivity.CPU
    with profile(activities=[activity]) as seen:
        row = work()
    spent, times = Counter[str](), Counter[str]()
    for event in seen.events() or ():
        if (event.device_type.name == "CUDA") == is_on_gpu:
            spent[event.name] += event.device_time_total if is_on_gpu else event.self_cpu_time_total
            times[event.name] += 1
    dearest = [[name[:120], round(us / 1000, 2), times[name]] for name, us in spent.most_common(most)]
    busy = {"busy_ms": round(sum(spent.values()) / 1000, 1), "kernels": sum(times.values()), "dearest": dearest}
    return {**row, **busy}


def measured(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Yield the machine, then every frame."""
    settings: dict[str, Any] = dict(text.split("=", 1) for text in options.settings)
    yield machine()
    with open_recording(options.source, recipe_for(options.method, settings)) as source:
        frames = [source.stored_frame(index) for index in range(min(options.frames, source.info.num_frames))]
        for queued in (False, True) if options.queued else (False,):
            counted = Counted()
            encoder = encoder_for(options.method, source, settings=settings)
            with counted.watching(queued=queued):
                for frame in frames:
                    once = partial(encoded, encoder, frame, counted)
                    is_looked_into = options.kernels and frame is frames[-1]
                    yield {"queued": queued, **(profiled(once) if is_looked_into else once())}


def main(words: list[str] | None = None) -> None:
    """Read the command line and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source")
    parser.add_argument("settings", nargs="*", metavar="KEY=VALUE")
    parser.add_argument("--method", default="s2gs-edge")
    parser.add_argument("--frames", type=int, default=6)
    parser.add_argument("--kernels", action="store_true", help="profile the last frame: what kept the GPU busy")
    parser.add_argument("--queued", action="store_true", help="once more, operation by operation")
    for row in measured(parser.parse_args(words)):
        print(json.dumps(row), flush=True)


if __name__ == "__main__":
    main()
