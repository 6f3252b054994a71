"""``auto`` tried out: short frames 0 without some of the training cameras, judged on those. Ours.

A rule knows the cameras and the seeds, not what they are worth: how many Gaussians a scene can pin down shows in a
camera that nobody fitted. So the rules say where to begin and which way to look (``engine.auto.rules``), trials say how
good a place is (``engine.auto.short_fits``), and a search goes on step by step while it gets better
(``engine.auto.climb``).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from gsstream.core.frame import Frame, PointCloud
from gsstream.engine.assembly.assemble import Assembly, value_at
from gsstream.engine.auto.climb import try_out
from gsstream.engine.auto.facts import scene_facts
from gsstream.engine.auto.rules import DEGREE, USUAL_DEGREE, settle, taken_over
from gsstream.engine.auto.short_fits import FirstFrameTrials, left_out
from gsstream.packet import PlayerState, StreamMeta


def choose(
    parts: Assembly,
    points: Callable[[], PointCloud],
    frame: Frame,
    meta: StreamMeta,
    first: PlayerState | None,
    say: Callable[[str], None],
) -> Assembly:
    """Return the assembly with every ``auto`` replaced by what this scene decides.

    Rules choose first; where frame 0 is made here and training cameras can be spared, trials go on from there.

    Arguments:
        points: the seeds, made when they are asked for.
        frame: training images of frame 0.
        first: the frame 0 of another stream that is taken over, whose choices stand.
        say: told of every trial.
    """
    usual = usual_values(parts)
    parts = settle(parts, lambda: scene_facts(points(), frame), taken_over(first) if first else {})
    settings = parts.recipe.first_frame
    folds = left_out(len(frame.cameras), settings.trial_cameras, settings.trial_folds)
    if first is not None or not parts.stepper.reads("structure") or not folds:
        return parts
    return try_out(parts, usual, FirstFrameTrials(points(), frame, meta, parts.recipe.seed, folds), say)


def usual_values(parts: Assembly) -> dict[str, Any]:
    """Return the defaults of the parts where the recipe says ``auto``, by key."""
    usual: dict[str, Any] = {DEGREE: USUAL_DEGREE}
    for slot, *inner in parts.pending:
        if slot != "first_frame":
            config = getattr(parts, slot).config.model_dump()
            usual[".".join((slot, *inner))] = value_at(config, ".".join(inner[1:]))
    return usual
