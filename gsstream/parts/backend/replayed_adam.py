"""Adam of a GPU, whose steps and whose residual optimisers are recorded once and replayed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import torch

from gsstream.core.gaussians import Gaussians
from gsstream.parts.backend.adam import ReferenceAdam
from gsstream.parts.render.replay import Recorder, RecordError, Records
from gsstream.parts.residual.adam_state import AdamState
from gsstream.parts.residual.layout import JointLayout
from gsstream.parts.residual.optimiser import Gates, ResidualOptimiser
from gsstream.parts.residual.replayed import ReplayedResidualOptimiser

NAME = "steps of Adam"


class _Asked(NamedTuple):
    """What a step is made from. ``places``: of the tables in memory, which a record changes there."""

    gradients: Mapping[str, torch.Tensor]
    lrs: Mapping[str, float | torch.Tensor]
    places: tuple[int, ...]


class ReplayedAdam(ReferenceAdam):
    """Steps are those of the reference, in torch on the device; a renderer may override :meth:`move` with its own.

    Arguments:
        recorder: of the device; None: nothing is recorded.
    """

    def __init__(self, recorder: Recorder | None) -> None:
        self._records = None if recorder is None else Records(recorder, keep=2)
        self._last: dict[str, object] = {}
        self._varying: set[str] = set()

    def step(
        self,
        values: Mapping[str, torch.Tensor],
        gradients: Mapping[str, torch.Tensor],
        states: Mapping[str, AdamState],
        lrs: Mapping[str, float | torch.Tensor],
    ) -> None:
        records = self._records
        if records is None or not records.can(NAME) or not gradients or any(g.numel() == 0 for g in gradients.values()):
            super().step(values, gradients, states, lrs)
            return
        changed = [values[name].detach() for name in gradients]
        for name in gradients:
            changed += [states[name].exp_avg, states[name].exp_avg_sq, states[name].steps]
        asked = _Asked(
            {name: gradient.detach() for name, gradient in gradients.items()},
            {name: self._rate(name, lrs[name], changed[0].device) for name in gradients},
            tuple(table.data_ptr() for table in changed),
        )

        def step(now: _Asked) -> None:
            ReferenceAdam.step(self, values, now.gradients, states, now.lrs)

        try:
            records.call(NAME, step, asked, changed)
        except RecordError:
            super().step(values, gradients, states, lrs)

    def _rate(self, name: str, rate: float | torch.Tensor, device: torch.device) -> float | torch.Tensor:
        """A rate that changes between steps as a tensor []; one that never did as it is, part of the record."""
        if isinstance(rate, torch.Tensor):
            return rate
        if self._last.setdefault(name, rate) != rate:
            self._varying.add(name)
        return torch.full((), rate, device=device) if name in self._varying else rate

    def residual_optimiser(
        self, code: JointLayout, base: Gaussians[torch.Tensor], units: torch.Tensor, matrix: torch.Tensor
    ) -> ResidualOptimiser[Any]:
        return ReplayedResidualOptimiser(
            code=code, base=base, units=units, matrix=matrix, optimiser=self, known_gates=self.known_gates
        )

    def known_gates(self, gates: Gates) -> Gates:
        """Return gates of which all rows are trained; an override may take fewer operations for the same numbers."""
        return gates
