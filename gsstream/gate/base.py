"""GateSampler: the share of the residual that a node lets through."""

from __future__ import annotations

from abc import abstractmethod

import torch

from gsstream.core.part import Part
from gsstream.core.state import GateState


class GateSampler(Part):
    """Samples gates in [0, 1] from trainable logits.

    Noise is an argument, so sampling is a pure function. A closed gate is exactly 0.0 and a fully open one exactly 1.0;
    every value is k / num_levels. ``sample(state, None)`` is the gate that goes into the packet.
    """

    @property
    @abstractmethod
    def num_levels(self) -> int:
        """Number of non-zero gate values, 1 (binary) to 255."""

    @abstractmethod
    def init(self, logits: torch.Tensor) -> GateState:
        """Start a frame from propagated confidence logits [M]; bounds on the logit are a documented setting."""

    @abstractmethod
    def noise(self, num_nodes: int, generator: torch.Generator) -> torch.Tensor | None:
        """Noise [M] for one training step, or None for a deterministic sampler."""

    @abstractmethod
    def sample(self, state: GateState, noise: torch.Tensor | None) -> torch.Tensor:
        """Gates [M]; differentiable in ``state.logits`` unless the gates are constant."""

    @abstractmethod
    def open_probability(self, state: GateState) -> torch.Tensor:
        """[M] probability that a gate is not zero; differentiable."""

    @abstractmethod
    def bound(self, state: GateState) -> GateState:
        """Project the logits back into their documented bounds after an optimiser step."""
