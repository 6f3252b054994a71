"""What looking closely costs: processor seconds of a frame at every level of ``GSSTREAM_CHECKS``, side by side.

Usage: python -m tools.checks_cost --source demo [--method s2gs-edge] [--frames 4] [--first-frame STREAM]
       [--set KEY=VALUE ...]

Each frame is encoded at every level from the same state, in turns, so that what else the machine does falls on all.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from statistics import median

from gsstream.engine.assembly.assemble import Assembly, assemble
from gsstream.engine.assembly.checks import Checks
from gsstream.engine.frame0.points import gather_points
from gsstream.engine.run.encoder import Encoder
from gsstream.engine.run.recording import open_recording, read_first_frame
from gsstream.input.recordings.base import FrameSource
from gsstream.packet import PlayerState
from gsstream.plugins.catalog import load_catalog
from gsstream.recipe.load import resolve_recipe


def measure(
    parts: Assembly, source: FrameSource, frames: int, first: PlayerState | None, rounds: int = 3
) -> dict[Checks, list[float]]:
    """Level -> processor seconds of each frame: the least of ``rounds`` repetitions.

    Raises AssertionError when two levels write different packets: looking must change nothing.
    """
    settings = parts.recipe.first_frame
    encoder = Encoder(
        parts, source.info, lambda frame: gather_points(source.points, frame, settings, encoder.rng), first_frame=first
    )
    state = encoder.encode(source.frame(0)).state
    spent: dict[Checks, list[float]] = {level: [] for level in Checks}
    for index in range(1, frames + 1):
        frame, packets = source.frame(index), set()
        seconds: dict[Checks, list[float]] = {level: [] for level in Checks}
        for _ in range(rounds):
            for level in Checks:
                other = Encoder(replace(parts, checks=level), source.info)
                other.state = replace(state, session=None)
                started = time.process_time()
                step = other.encode(frame)
                seconds[level].append(time.process_time() - started)
                packets.add(step.packet.data)
        assert len(packets) == 1, f"frame {index}: levels of checks changed what is sent"
        for level in Checks:
            spent[level].append(min(seconds[level]))
        state = step.state
    return spent


def main(arguments: Sequence[str] | None = None) -> int:
    """Run as a command; returns the exit code."""
    import torch

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--source", default="demo")
    parser.add_argument("--method", default="s2gs-edge")
    parser.add_argument("--frames", type=int, default=4)
    parser.add_argument("--first-frame", type=Path)
    parser.add_argument("--set", action="append", default=[], dest="sets", metavar="KEY=VALUE")
    given = parser.parse_args(arguments)
    torch.set_num_threads(1)
    catalog = load_catalog()
    parts = assemble(resolve_recipe(given.method, catalog.recipe_path, (), [("--set", s) for s in given.sets]), catalog)
    source = open_recording(given.source, parts.recipe, catalog)
    first = None if given.first_frame is None else read_first_frame(given.first_frame)
    spent = measure(parts, source, given.frames, first)
    source.close()
    print("| level | cpu s/frame | of off |\n|---|--:|--:|")
    for level, seconds in spent.items():
        share = median(a / b for a, b in zip(seconds, spent[Checks.OFF], strict=True))
        print(f"| {level} | {median(seconds):.3f} | {share:.3f} |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
