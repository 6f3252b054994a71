"""What one frame's optimisation is given, and what it finds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import torch

from gsstream.core.changes import Layout
from gsstream.core.gaussians import Gaussians
from gsstream.core.hierarchy import Hierarchy
from gsstream.parts.render.base import RenderSession
from gsstream.parts.render.target import ViewTarget


@dataclass(frozen=True)
class Problem:
    """The input of one frame's optimisation.

    Arguments:
        layout, hierarchy: how the scene is stored and grouped.
        rows: [A] int64 candidates, ascending.
        base: those rows of the scene that the residual is added to.
        logits: [M] initial gate logits.
        decoders: attribute -> [L, D] linear decoder to go on from.
        session: a render session in which only ``rows`` change.
        target: view -> what its render is compared with in the next iteration.
        views: training cameras; pixels: of one view.
        generator: of noise and of the order of views.
        step_scale: factor on the update rule's quantisation steps.
    """

    layout: Layout
    hierarchy: Hierarchy
    rows: torch.Tensor
    base: Gaussians[torch.Tensor]
    logits: torch.Tensor
    decoders: Mapping[str, torch.Tensor]
    session: RenderSession
    target: Callable[[int], ViewTarget]
    views: int
    pixels: int
    generator: torch.Generator
    step_scale: float = 1.0


@dataclass(frozen=True)
class Solution:
    """The result of one frame's optimisation, in the processor's memory.

    Arguments:
        rows: [A] int64 rows that stayed to the end, ascending; what other rows had is given up.
        latents: attribute -> [A, L].
        decoders: attribute -> [L, D] as trained.
        logits: [M] of all gates.
        loss: mean over the last pass, of the tiles that took part.
        iterations: views rendered.
        curvature: attribute -> [A, L], mean squared gradient of the latents: what a latent is worth, up to a factor.
        dead_gates: gates of rows that stayed which ended where nothing moves them (:func:`count_dead_gates`).
        open_gates: how many gates would have been sent open after each epoch.
    """

    rows: torch.Tensor
    latents: Mapping[str, torch.Tensor]
    decoders: Mapping[str, torch.Tensor]
    logits: torch.Tensor
    loss: float = 0.0
    iterations: int = 0
    curvature: Mapping[str, torch.Tensor] = field(default_factory=dict)
    dead_gates: int = 0
    open_gates: Sequence[int] = ()
