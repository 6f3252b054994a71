"""The residual's optimiser of a GPU: an iteration is recorded once, and a pass replays it without a wait."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple, final

import torch

from gsstream.core.gaussians import Gaussians
from gsstream.core.part import unwrapped
from gsstream.parts.render.replay import RecordError, Records
from gsstream.parts.render.replayed import ReplayedSession, SeenView
from gsstream.parts.residual.adam_state import RowSteps
from gsstream.parts.residual.layout import JointLayout
from gsstream.parts.residual.optimiser import Gates, Iteration, ResidualEpoch
from gsstream.parts.residual.reference import JointResidualOptimiser

#: How often a pass is made where views were not drawn: the lists of their tiles are longer the second time.
TRIES = 2


class _Asked(NamedTuple):
    """What differs between iterations, in tensors."""

    seen: SeenView
    noise: torch.Tensor | None
    lr_factor: float | torch.Tensor
    rd_lambda: float | torch.Tensor


@final
class ReplayedResidualOptimiser(JointResidualOptimiser):
    """A pass is the default body, replayed. Where a check failed, the pass is made again one by one, which names it.

    Arguments:
        known_gates: returns gates that do what it is given, in fewer operations where it knows them.
    """

    def __init__(
        self,
        code: JointLayout,
        base: Gaussians[torch.Tensor],
        units: torch.Tensor,
        matrix: torch.Tensor,
        optimiser: RowSteps,
        known_gates: Callable[[Gates], Gates],
    ) -> None:
        super().__init__(code=code, base=base, units=units, matrix=matrix, optimiser=optimiser)
        self._known_gates = known_gates
        self._records: Records | None = None
        self._made_from: object = None

    def run(self, epoch: ResidualEpoch[Any]) -> list[torch.Tensor]:
        is_frozen = any(now.frozen is not None for now in epoch.iterations)  # their number would be read
        if not is_frozen:
            epoch = replace(epoch, gates=self._known_gates(epoch.gates))
        noises = [epoch.gates.noise() for _ in epoch.iterations]
        name, records = f"iterations with {type(unwrapped(epoch.gates.gate)).__name__}", epoch.session.records
        if records is None or is_frozen or not records.can(name):
            return self.run_with(epoch, noises)
        if self._made_from is not records:
            self._made_from, self._records = records, records.beside()
        tables = self._tables(epoch.gates)
        kept = [table.clone() for table in tables]
        for _ in range(TRIES):
            try:
                losses = self._replayed(name, epoch, noises)
            except RecordError:
                losses = None
            if losses is not None:
                return losses
            self.latents.grad = epoch.gates.logits.grad = None
            torch._foreach_copy_(tables, kept)
            if not records.can(name):
                break
        return self.run_with(epoch, noises)

    def _replayed(
        self, name: str, epoch: ResidualEpoch[Any], noises: Sequence[torch.Tensor | None]
    ) -> list[torch.Tensor] | None:
        """Losses of the iterations; None where a check failed, or a view was not drawn."""
        session, gates, tables = epoch.session, epoch.gates, self._tables(epoch.gates)
        price = self._number(epoch.rd_lambda, 0.0)
        # Every view beforehand, so that what one of them needs is there before anything is recorded.
        asked = [
            _Asked(session.seen(now.view, now.target), noise, self._number(now.lr_factor, 1.0), price)
            for now, noise in zip(epoch.iterations, noises, strict=True)
        ]

        def iterate(now: _Asked) -> torch.Tensor:
            made: ReplayedSession = session.drawing(now.seen)
            one = Iteration(0, now.seen.target, None, now.lr_factor)
            return self.iterate(made, gates, one, noise=now.noise, rd_lambda=now.rd_lambda)

        assert self._records is not None
        losses = []
        for place, now in enumerate(asked):
            epoch.begin(place)
            losses.append(self._records.call(name, iterate, now, tables))
        if self._records.held():
            return losses
        self._records = self._records.beside()
        return None

    def _number(self, value: float | torch.Tensor, usual: float) -> float | torch.Tensor:
        """A number that changes between replays as a tensor [] of the device; the usual one as it is."""
        return value if value == usual else torch.full((), float(value), device=self.latents.device)

    def _tables(self, gates: Gates) -> list[torch.Tensor]:
        """All that an iteration changes."""
        moments = [*self._latents.moments("latents").values(), *self._decoders.moments("matrix").values()]
        state = gates.state
        moments += [state.exp_avg, state.exp_avg_sq, state.steps]
        return [self.latents.detach(), self.matrix, gates.logits.detach(), *moments]

    def select_rows(self, rows: torch.Tensor) -> None:
        super().select_rows(rows)
        self._made_from = None
