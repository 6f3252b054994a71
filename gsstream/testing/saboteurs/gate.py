"""Saboteurs of the checks of gates."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch

from gsstream.core.state import GateState, rows
from gsstream.testing.examples.gate import ExampleGate
from gsstream.testing.saboteurs.register import spoils

Gate: Any = ExampleGate


@spoils("check_gate_range_and_levels")
class AlmostClosed(Gate):
    """A closed gate is not exactly 0, so no row can be left out."""

    def sample(self, state: GateState, noise: torch.Tensor | None) -> torch.Tensor:
        gates: torch.Tensor = super().sample(state, noise)
        return gates - 1e-8 * (gates.detach() == 0)


@spoils("check_gate_init_calibrated")
class Sceptic(Gate):
    """Starts half a logit below the confidence."""

    def init(self, logits: torch.Tensor) -> GateState:
        state: GateState = super().init(logits - 0.5)
        return state


@spoils("check_gate_calibration")
class OneGumbel(Gate):
    """One Gumbel draw instead of the difference of two: a gate of 0.5 opens in 63 % of all draws."""

    def noise(self, num_nodes: int, generator: torch.Generator) -> torch.Tensor | None:
        u = torch.rand(num_nodes, generator=generator).double() + 2.0**-25
        return (-torch.log(-torch.log(u))).float()


@spoils("check_gate_really_stochastic")
class Table(Gate):
    """Takes the noise of hierarchies of 256 nodes from a table that never changes."""

    def noise(self, num_nodes: int, generator: torch.Generator) -> torch.Tensor | None:
        generator = torch.Generator().manual_seed(0) if num_nodes == 256 else generator
        noise: torch.Tensor | None = super().noise(num_nodes, generator)
        return noise


@spoils("check_gate_noise_is_data")
class Neighbour(Gate):
    """Every gate uses the noise of the gate before it."""

    def sample(self, state: GateState, noise: torch.Tensor | None) -> torch.Tensor:
        gates: torch.Tensor = super().sample(state, None if noise is None else noise.roll(1))
        return gates


@spoils("check_gate_monotone")
class Doubtful(Gate):
    """The surest gates say that they are less sure."""

    def open_probability(self, state: GateState) -> torch.Tensor:
        p: torch.Tensor = super().open_probability(state)
        return torch.where(state.logits > 6.2, 0.99 * p, p)


@spoils("check_gate_gradient_flow")
class Clamped(Gate):
    """A clamp after rounding, as released: a gate at 0 or 1 has no gradient."""

    def sample(self, state: GateState, noise: torch.Tensor | None) -> torch.Tensor:
        gates: torch.Tensor = super().sample(state, noise)
        return gates.detach() + 0.0 * (gates - gates.detach())


@spoils("check_gate_extremes")
class Overflow(Gate):
    """The sigmoid as exp(z) / (1 + exp(z)): infinity over infinity for large logits."""

    def sample(self, state: GateState, noise: torch.Tensor | None) -> torch.Tensor:
        gates: torch.Tensor = super().sample(state, noise)
        power = torch.exp(state.logits / self.config.temperature)
        soft = power / (1 + power)
        return gates + 0 * (soft - soft.detach())


@spoils("check_gate_temperature_limit")
class Thaw(Gate):
    """Gates soften as the temperature falls."""

    @property
    def num_levels(self) -> int:
        return 10 if self.config.temperature < 0.2 else 1

    def sample(self, state: GateState, noise: torch.Tensor | None) -> torch.Tensor:
        gates: torch.Tensor = super().sample(state, noise)
        return 0.9 * gates if self.num_levels == 10 else gates


@spoils("check_gate_deterministic_is_final")
class TwoFaced(Gate):
    """A higher threshold while no gradient is recorded: the packet gets other gates than the loss."""

    def sample(self, state: GateState, noise: torch.Tensor | None) -> torch.Tensor:
        shift = 0.0 if state.logits.requires_grad or noise is not None else -0.2
        gates: torch.Tensor = super().sample(GateState(state.logits + shift), noise)
        return gates


@spoils("check_gate_bound")
class Creeping(Gate):
    """Bounding again moves large logits a little further."""

    def init(self, logits: torch.Tensor) -> GateState:
        super().init(logits)
        return GateState(logits.detach().clamp(-7, 7))

    def bound(self, state: GateState) -> GateState:
        bounded: torch.Tensor = super().bound(state).logits
        return GateState(torch.where(bounded.abs() > 6.5, bounded - 0.1 * (bounded - 6.5 * bounded.sign()), bounded))


@dataclass(frozen=True)
class Smuggled(GateState):
    """A state with a field that nobody saves."""

    shift: torch.Tensor | None = rows(None, default=None)


@spoils("check_gate_state_resume")
class Smuggler(Gate):
    """Hides something in its state that is lost when the state is saved."""

    def init(self, logits: torch.Tensor) -> GateState:
        state: GateState = super().init(logits)
        return Smuggled(state.logits, torch.tensor(0.3) if len(logits) == 200 else None)

    def sample(self, state: GateState, noise: torch.Tensor | None) -> torch.Tensor:
        shift = getattr(state, "shift", None)
        gates: torch.Tensor = super().sample(state if shift is None else GateState(state.logits + shift), noise)
        return gates
