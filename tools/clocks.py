"""Measure the check of clocks: one camera of a recording that is in step is shifted, and what is found is printed.

    python -m tools.clocks RECORDING [--frames 60] [--cameras cam03 cam17] [--shifts -8 -3 -1 0 1 3 8]

The recording needs as many frames more as the largest shift, on both sides where shifts go both ways.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np

from gsstream.input.prepare.findings import Finding
from gsstream.input.prepare.picture_checks import Thumbnails, read_thumbnails
from gsstream.input.prepare.sync_checks import check_sync
from gsstream.input.prepare.validate import SMALL, rig_of
from gsstream.input.recordings.open import open_source


def main() -> None:
    """Print a row of a Markdown table for every camera and shift."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recording")
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--cameras", nargs="*", default=None, help="cameras to shift; the second one by default")
    parser.add_argument("--rig", nargs="*", default=None, help="cameras that are looked at; all by default")
    parser.add_argument("--shifts", type=int, nargs="*", default=[-8, -3, -1, 0, 1, 3, 8])
    asked = parser.parse_args()
    whole = open_source(asked.recording)
    rig = rig_of(whole)
    begin, more = max(0, -min(asked.shifts)), max(0, *asked.shifts)
    small = open_source(asked.recording, min(1.0, SMALL / rig.width))
    thumbs = read_thumbnails(small, rig, begin + asked.frames + more)
    if asked.rig:
        chosen = [rig.ids.index(name) for name in asked.rig]
        thumbs = Thumbnails(thumbs.images[:, chosen], rig.select(chosen), len(chosen))
    print("| camera | shifted by | found | seconds |\n|---|---|---|---|")
    for name in asked.cameras or thumbs.cameras.ids[1:2]:
        for shift in asked.shifts:
            began = time.perf_counter()
            found = check_sync(_shifted(thumbs, name, shift, begin=begin, frames=asked.frames))
            print(f"| {name} | {shift:+d} | {_told(found)} | {time.perf_counter() - began:.1f} |", flush=True)


def _shifted(thumbs: Thumbnails, name: str, shift: int, begin: int, frames: int) -> Thumbnails:
    images = np.array(thumbs.images[begin : begin + frames])
    c = thumbs.cameras.ids.index(name)
    images[:, c] = thumbs.images[begin + shift : begin + shift + frames, c]
    return replace(thumbs, images=images)


def _told(found: list[Finding]) -> str:
    return "; ".join(finding.message.split(":")[0] for finding in found) or "nothing"


if __name__ == "__main__":
    main()
