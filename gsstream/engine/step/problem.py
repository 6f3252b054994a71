"""What one frame's optimisation is given, and what it finds."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import torch

from gsstream.core.cameras import Cameras
from gsstream.core.changes import Layout
from gsstream.core.gaussians import Gaussians
from gsstream.core.hierarchy import Hierarchy
from gsstream.parts.render.session import RenderSession
from gsstream.parts.render.target import ViewTarget
from gsstream.parts.residual.layout import AttributeCode


@dataclass(frozen=True)
class Problem:
    """The input of one frame's optimisation."""

    #: layout, hierarchy: how the scene is stored and grouped.
    layout: Layout
    hierarchy: Hierarchy
    rows: torch.Tensor  # [A] int64 candidates, ascending
    base: Gaussians[torch.Tensor]  # those rows of the scene that the residual is added to
    logits: torch.Tensor  # [M] initial gate logits
    decoders: Mapping[str, torch.Tensor]  # attribute -> [L, D] linear decoder to go on from
    session: RenderSession  # a render session in which only ``rows`` change
    target: Callable[[int], ViewTarget]  # view -> what its render is compared with in the next iteration
    cameras: Cameras  # the training cameras
    generator: torch.Generator  # of noise and of the order of views
    codes: Mapping[str, AttributeCode]  # attribute -> how its residual is coded in this frame


@dataclass(frozen=True)
class Solution:
    """The result of one frame's optimisation, in the processor's memory."""

    rows: torch.Tensor  # [A] int64 rows that stayed to the end, ascending; what other rows had is given up
    latents: Mapping[str, torch.Tensor]  # attribute -> [A, L]
    decoders: Mapping[str, torch.Tensor]  # attribute -> [L, D] as trained
    logits: torch.Tensor  # [M] of all gates
    loss: float = 0.0  # mean over the last pass, of the tiles that took part
    iterations: int = 0  # views rendered
    #: Attribute -> [A, L], mean squared gradient of the latents: what a latent is worth, up to a factor.
    curvature: Mapping[str, torch.Tensor] = field(default_factory=dict)
    dead_gates: int = 0  # gates, of rows that stayed, that neither images nor price can move (:func:`count_dead_gates`)
    open_gates: Sequence[int] = ()  # how many gates would have been sent open after each epoch
