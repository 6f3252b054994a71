"""Saboteurs of the checks of gates."""

from __future__ import annotations

from typing import Any

import torch

from gsstream.parts.gate.base import AnalyticGate
from gsstream.testing.examples.gate import ExampleGate
from saboteurs.register import spoils

Gate: Any = ExampleGate


@spoils("check_gate_range_and_levels")
class AlmostClosed(Gate):
    """A closed gate is not exactly 0, so no row can be left out."""

    def sample(self, logits: torch.Tensor, noise: torch.Tensor | None) -> torch.Tensor:
        gates: torch.Tensor = super().sample(logits, noise)
        return gates - 1e-8 * (gates.detach() == 0)


@spoils("check_gate_init_calibrated")
class Sceptic(Gate):
    """Starts half a logit below the confidence."""

    def init(self, logits: torch.Tensor) -> torch.Tensor:
        start: torch.Tensor = super().init(logits - 0.5)
        return start


@spoils("check_gate_calibration")
class OneGumbel(Gate):
    """One Gumbel draw instead of the difference of two: a gate of 0.5 opens in 63 % of all draws."""

    def noise(self, num_nodes: int, generator: torch.Generator) -> torch.Tensor | None:
        u = torch.rand(num_nodes, generator=generator).double() + 2.0**-25
        return (-torch.log(-torch.log(u))).float()


@spoils("check_gate_stochastic")
class Table(Gate):
    """Takes the noise of hierarchies of 256 nodes from a table that never changes."""

    def noise(self, num_nodes: int, generator: torch.Generator) -> torch.Tensor | None:
        generator = torch.Generator().manual_seed(0) if num_nodes == 256 else generator
        noise: torch.Tensor | None = super().noise(num_nodes, generator)
        return noise


@spoils("check_gate_noise_is_data")
class Neighbour(Gate):
    """Every gate uses the noise of the gate before it."""

    def sample(self, logits: torch.Tensor, noise: torch.Tensor | None) -> torch.Tensor:
        gates: torch.Tensor = super().sample(logits, None if noise is None else noise.roll(1))
        return gates


@spoils("check_gate_monotone")
class Doubtful(Gate):
    """The surest gates say that they are less sure."""

    def open_probability(self, logits: torch.Tensor) -> torch.Tensor:
        p: torch.Tensor = super().open_probability(logits)
        return torch.where(logits > 6.2, 0.99 * p, p)


@spoils("check_gate_gradient_flow")
class Clamped(Gate):
    """A clamp after rounding, as released: a gate at 0 or 1 has no gradient."""

    def sample(self, logits: torch.Tensor, noise: torch.Tensor | None) -> torch.Tensor:
        gates: torch.Tensor = super().sample(logits, noise)
        return gates.detach() + 0.0 * (gates - gates.detach())


@spoils("check_gate_extremes")
class Overflow(Gate):
    """The sigmoid as exp(z) / (1 + exp(z)): infinity over infinity for large logits."""

    def sample(self, logits: torch.Tensor, noise: torch.Tensor | None) -> torch.Tensor:
        gates: torch.Tensor = super().sample(logits, noise)
        power = torch.exp(logits / self.config.temperature)
        soft = power / (1 + power)
        return gates + 0 * (soft - soft.detach())


@spoils("check_gate_temperature_limit")
class Thaw(Gate):
    """Gates soften as the temperature falls."""

    @property
    def num_levels(self) -> int:
        return 10 if self.config.temperature < 0.2 else 1

    def sample(self, logits: torch.Tensor, noise: torch.Tensor | None) -> torch.Tensor:
        gates: torch.Tensor = super().sample(logits, noise)
        return 0.9 * gates if self.num_levels == 10 else gates


@spoils("check_gate_deterministic_is_final")
class TwoFaced(Gate):
    """A higher threshold while no gradient is recorded: the packet gets other gates than the loss."""

    def sample(self, logits: torch.Tensor, noise: torch.Tensor | None) -> torch.Tensor:
        shift = 0.0 if logits.requires_grad or noise is not None else -0.2
        gates: torch.Tensor = super().sample(logits + shift, noise)
        return gates


@spoils("check_gate_clamp")
class Creeping(Gate):
    """Bounding again moves large logits a little further."""

    def init(self, logits: torch.Tensor) -> torch.Tensor:
        super().init(logits)
        return logits.detach().clamp(-7, 7)

    def bound(self, logits: torch.Tensor) -> torch.Tensor:
        bounded: torch.Tensor = super().bound(logits)
        return torch.where(bounded.abs() > 6.5, bounded - 0.1 * (bounded - 6.5 * bounded.sign()), bounded)


class Smuggled(torch.Tensor):
    """Logits with a note that nobody saves."""


@spoils("check_gate_state_resume")
class Smuggler(Gate):
    """Hides something in its logits that is lost when they are copied."""

    def init(self, logits: torch.Tensor) -> torch.Tensor:
        start: torch.Tensor = super().init(logits)
        return start.as_subclass(Smuggled) if len(logits) == 200 and not logits.requires_grad else start

    def sample(self, logits: torch.Tensor, noise: torch.Tensor | None) -> torch.Tensor:
        shift = 0.3 if isinstance(logits, Smuggled) else 0.0
        gates: torch.Tensor = super().sample(logits.as_subclass(torch.Tensor) + shift, noise)
        return gates


@spoils("check_gate_form")
class Understated(Gate):
    """States a closed form without the noise that it draws."""

    def form(self) -> AnalyticGate:
        return AnalyticGate(0.3, self.num_levels, 0.0, 7.0)
