"""Saboteurs of the common checks."""

from __future__ import annotations

from types import MappingProxyType
from typing import Any

import torch

from gsstream.testing.examples.confidence import ExampleConfidence
from gsstream.testing.examples.gate import ExampleGate
from gsstream.testing.examples.propagation import ExamplePropagation
from saboteurs.register import spoils

# The examples are final; only a saboteur may inherit from them, and only behind the type checker's back.
Gate: Any = ExampleGate
Propagation: Any = ExamplePropagation
Confidence: Any = ExampleConfidence


@spoils("check_config_round_trip")
class Unexplained(Gate):
    """A setting without a description."""

    class Config(ExampleGate.Config):
        secret: float = 1.0


@spoils("check_frozen_and_final", leave=True)
class Open(Gate):
    """Not marked final."""


@spoils("check_docstring")
class Undescribed(Gate):
    """Has no docstring."""

    __doc__ = ""


@spoils("check_citation")
class Unsourced(Gate):
    """Cites nothing."""

    source = " "


@spoils("check_denials")
class Evasive(Gate):
    """Denies a check that there is not."""

    denied = MappingProxyType({"check_gate_kindness": "no gate has ever been kind, and this one is none"})


@spoils("check_pure")
class Meddler(Propagation):
    """Changes the logits it is given, by the last bit of the first."""

    def propagate(self, logits: torch.Tensor, hierarchy: Any) -> torch.Tensor:
        spread: torch.Tensor = super().propagate(logits, hierarchy)
        if not logits.requires_grad:
            logits[:1] = torch.nextafter(logits[:1], torch.full_like(logits[:1], torch.inf))
        return spread


@spoils("check_rng_isolated")
class Gambler(Gate):
    """Draws from the global generator besides its own."""

    def noise(self, num_nodes: int, generator: torch.Generator) -> torch.Tensor | None:
        torch.rand(1)
        noise: torch.Tensor | None = super().noise(num_nodes, generator)
        return noise


@spoils("check_dtype_and_device")
class Narrow(Gate):
    """Gates are float32, whatever the logits are."""

    def sample(self, logits: torch.Tensor, noise: torch.Tensor | None) -> torch.Tensor:
        gates: torch.Tensor = super().sample(logits, noise)
        return gates.float()


@spoils("check_device")
class Stranded(Gate):
    """Makes a tensor on the processor, wherever its inputs are."""

    def sample(self, logits: torch.Tensor, noise: torch.Tensor | None) -> torch.Tensor:
        gates: torch.Tensor = super().sample(logits, noise)
        return gates + torch.zeros(len(logits), dtype=logits.dtype)


@spoils("check_extremes")
class NeverEmpty(Gate):
    """Takes the maximum of no logits."""

    def init(self, logits: torch.Tensor) -> torch.Tensor:
        logits.max()
        start: torch.Tensor = super().init(logits)
        return start


@spoils("check_rejects_nonfinite")
class Mender(Propagation):
    """Replaces what is not finite by 0 and says nothing."""

    def propagate(self, logits: torch.Tensor, hierarchy: Any) -> torch.Tensor:
        mended = torch.where(torch.isfinite(logits), logits, torch.zeros_like(logits))
        spread: torch.Tensor = super().propagate(mended, hierarchy)
        return spread


@spoils("check_permutation")
class Ranked(Confidence):
    """Later rows are trusted less."""

    def estimate(self, context: Any) -> torch.Tensor:
        logits: torch.Tensor = super().estimate(context)
        return logits - 0.01 * torch.arange(len(logits), device=logits.device) / max(len(logits), 1)
