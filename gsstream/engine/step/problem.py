"""What one frame's optimisation is given, and what it finds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch

from gsstream.core.changes import Layout
from gsstream.core.gaussians import Gaussians
from gsstream.core.hierarchy import Hierarchy
from gsstream.engine.budget.pace import Allowance, Pace
from gsstream.engine.fit.judge import Judge
from gsstream.render.base import RenderSession


@dataclass(frozen=True)
class Problem:
    """The input of one frame's optimisation.

    Arguments:
        frame: index of the frame.
        effort: share of the recipe's epochs that the frame is worth, 0 to 1.
        layout, hierarchy: how the scene is stored and grouped.
        rows: [A] int64 candidates, ascending.
        base: those rows of the scene that the residual is added to.
        logits: [M] initial gate logits.
        decoders: attribute -> [L, D] linear decoder to go on from.
        session: a render session in which only ``rows`` change.
        judge: compares renders with what the V cameras recorded.
        pixels: of one view.
        allowance: what the frame may spend; None: what the recipe says.
        near: [V, ceil(H / 16), ceil(W / 16)] bool, tiles that every iteration looks at; None: at all.
    """

    frame: int
    effort: float
    layout: Layout
    hierarchy: Hierarchy
    rows: torch.Tensor
    base: Gaussians[torch.Tensor]
    logits: torch.Tensor
    decoders: Mapping[str, torch.Tensor]
    session: RenderSession
    judge: Judge
    views: int
    pixels: int
    allowance: Allowance | None = None
    near: torch.Tensor | None = None

    @property
    def step_scale(self) -> float:
        """Factor on the update rule's quantisation steps."""
        return 1.0 if self.allowance is None else self.allowance.plan.step_scale


@dataclass(frozen=True)
class Solution:
    """The result of one frame's optimisation.

    Arguments:
        rows: [A] int64 rows that stayed to the end, ascending; what other rows had is given up.
        latents: attribute -> [A, L].
        decoders: attribute -> [L, D] as trained.
        logits: [M] of all gates.
        loss: mean over the last pass, of the tiles that took part.
        iterations: views rendered.
        curvature: attribute -> [A, L], mean squared gradient of the latents: what a latent is worth, up to a factor.
        pace: what the passes were held to.
        dead_gates: gates of rows that stayed which ended where nothing moves them (:func:`count_dead`).
    """

    rows: torch.Tensor
    latents: Mapping[str, torch.Tensor]
    decoders: Mapping[str, torch.Tensor]
    logits: torch.Tensor
    loss: float = 0.0
    iterations: int = 0
    curvature: Mapping[str, torch.Tensor] = field(default_factory=dict)
    pace: Pace | None = None
    dead_gates: int = 0
