"""Gaussians that a frame adds and removes, as the growth part proposes them."""

from __future__ import annotations

from dataclasses import replace

from gsstream.core.changes import Delta, apply_delta
from gsstream.core.rng import Rng
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.assembly.guard import error_context
from gsstream.engine.state.stream_state import StreamState
from gsstream.engine.step.context import EngineContext
from gsstream.parts.growth.none import NoGrowth


def with_growth(parts: Assembly, state: StreamState, delta: Delta, view: EngineContext, rng: Rng) -> Delta:
    """Return the delta with the rows that leave, of which those of the shell stay, and those that join.

    Raises ComponentError when the part fails, or proposes what does not fit the scene.
    """
    if isinstance(parts.part("growth"), NoGrowth):
        return delta  # the scene after the residual is not needed
    after = apply_delta(state.player.scene, delta)
    rows = parts.growth.propose(after, view, rng)
    with error_context("growth", parts.part("growth"), parts.where):
        if rows is not None:
            apply_delta(after, Delta((rows,)))  # before rows are left out: a wrong proposal gets an error
            rows = replace(rows, removed=rows.removed[~view.shell_rows.cpu().numpy()[rows.removed]])
    return delta.with_row_edit(rows)
