"""Which rows a frame's residual is learned for, and how sure their gates are at the start."""

from __future__ import annotations

from typing import NamedTuple

import torch

from gsstream.core.hierarchy import Hierarchy
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.step.active.candidates import CHANGE_VOTES, candidates
from gsstream.engine.step.context import EngineContext
from gsstream.parts.update.base import Scope


class Selected(NamedTuple):
    """Rows [A] int64, ascending, that take part, and logits [M] of the gates."""

    rows: torch.Tensor
    logits: torch.Tensor


def select(parts: Assembly, view: EngineContext, hierarchy: Hierarchy, scope: Scope) -> Selected:
    """Return what confidence, propagation and gate choose; none of them is called in a frame without a residual."""
    if scope is Scope.NONE:
        nothing = view.gaussians.means.new_zeros(0, dtype=torch.int64)
        return Selected(nothing, view.gaussians.means.new_zeros(hierarchy.num_nodes))
    seen = view.everywhere() if scope is Scope.ALL else view
    confidence = parts.propagation.propagate(parts.confidence.estimate(seen), hierarchy)
    logits = parts.gate.init(confidence)
    open_probability = parts.gate.open_probability(logits)
    able = seen.changed_rows(CHANGE_VOTES)
    return Selected(candidates(able, open_probability, hierarchy, parts.recipe.stream.active_threshold), logits)
