"""Advice about few cameras: the quality to expect, before a run, and the measures taken in frame 0, after it."""

from __future__ import annotations

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.focus import focus_point
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.frame0.regularisers import choose_regularisers
from gsstream.input.seeds.room import stands_around
from gsstream.input.seeds.shell import SEEDS

#: Fewer cameras than this, or neighbours farther apart than so many degrees, are worth a sentence.
ENOUGH_CAMERAS, CLOSE_DEGREES = 6, 45.0
#: Held-out quality of frame 0 by number of cameras, in a room and from one side (docs/results/extremes.md).
AROUND = "4 cameras around a room 20 dB, 6 cameras 24, 8 cameras 25, 27 cameras 30"
ONE_SIDE = "4 cameras along an arc of 68 degrees 28 dB, 6 cameras 31, 11 cameras 33"


def widest_gap(cameras: Cameras) -> float:
    """Return the largest angle between a camera and its nearest neighbour, degrees, at the point that all look at."""
    outward = cameras.centers - focus_point(cameras)
    outward = outward / np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-12)
    angles = np.degrees(np.arccos(np.clip(outward @ outward.T, -1, 1)))
    np.fill_diagonal(angles, np.inf)
    return float(angles.min(1).max()) if len(cameras) > 1 else 0.0


def expectation(cameras: Cameras) -> str:
    """Return one sentence on the quality that few or distant cameras allow, and on a cure; empty for enough cameras."""
    gap = widest_gap(cameras)
    if len(cameras) >= ENOUGH_CAMERAS and gap <= CLOSE_DEGREES:
        return ""
    number = f"{len(cameras)} training camera{'s'[: len(cameras) != 1]}"
    apart = f", of which one is {gap:.0f} degrees from the nearest other" if len(cameras) > 1 else ""
    measured = AROUND if stands_around(cameras) else ONE_SIDE
    return (
        f"{number}{apart}: views between them will be soft or wrong where one camera sees alone (held-out views, "
        f"measured: {measured}); more cameras in between help most, then depth maps or points of the recording's own"
    )


def first_frame_summary(assembly: Assembly, cameras: Cameras, seeds: str) -> str:
    """Return one line on the measures taken in frame 0, and their reason; ``seeds``: source of the first points."""
    settings = assembly.recipe.first_frame
    chosen, number = choose_regularisers(settings, cameras), len(cameras)
    colour = ", ".join(f"{value:.2f}" for value in assembly.background)
    why = "the mean of its images" if assembly.recipe.background == "auto" else "as the recipe says"
    said = [f"seeds: {seeds}", f"background ({colour}), {why}"]
    if settings.shell:
        said.append(f"{SEEDS} large seeds behind the scene")
    if chosen.dropout:
        said.append(f"dropout {chosen.dropout:g}, because {number} cameras cannot tell a surface from a cloud")
    if chosen.depth_smoothness:
        said.append(f"smoothness of depth {chosen.depth_smoothness:g}, because {_why_smooth(cameras)}")
    return f"frame 0 was made with {'; '.join(said)}"


def _why_smooth(cameras: Cameras) -> str:
    where = "around a room" if stands_around(cameras) else "on one side"
    return f"{len(cameras)} cameras {where} leave depth open where nothing is drawn"
