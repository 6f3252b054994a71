"""What one frame's optimisation is given, and what it finds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch

from gsstream.core.frame import Frame
from gsstream.core.gaussians import Gaussians
from gsstream.core.state import GateState
from gsstream.engine.budget.pace import Allowance, Pace
from gsstream.engine.state.stream_state import StreamState
from gsstream.render.base import RenderSession


@dataclass(frozen=True)
class Problem:
    """What one frame's optimisation is given.

    Arguments:
        active: [A] int64 rows that may change, ascending.
        base: those rows of the decoded previous scene.
        gate: initial gate state [M].
        session: an open render session in which only ``active`` changes.
        allowance: what the frame may spend; None: what the recipe says.
    """

    state: StreamState
    frame: Frame
    active: torch.Tensor
    base: Gaussians[torch.Tensor]
    gate: GateState
    session: RenderSession
    allowance: Allowance | None = None

    @property
    def step_scale(self) -> float:
        """Factor on the update rule's quantisation steps."""
        return 1.0 if self.allowance is None else self.allowance.plan.step_scale


@dataclass(frozen=True)
class Solution:
    """What the optimisation found.

    Arguments:
        active: [A] int64 rows that stayed to the end, ascending; what other rows had is given up.
        latents: attribute -> [A, L].
        loss: mean over the last pass, of the tiles that took part.
        iterations: views rendered.
        curvature: attribute -> [A, L], mean squared gradient of the latents: what a latent is worth, up to a factor.
        pace: what the passes were held to.
        dead_gates: gates of rows that stayed which ended where nothing moves them (:func:`count_dead`).
    """

    active: torch.Tensor
    latents: Mapping[str, torch.Tensor]
    decoders: Mapping[str, torch.Tensor]
    gate: GateState
    gate_moments: Mapping[str, torch.Tensor]
    loss: float
    iterations: int
    curvature: Mapping[str, torch.Tensor] = field(default_factory=dict)
    pace: Pace | None = None
    dead_gates: int = 0
