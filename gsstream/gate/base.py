"""GateSampler: the share of the residual that a node lets through."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import torch

from gsstream.core.part import Part, Traits


@dataclass(frozen=True, slots=True)
class GateTraits(Traits):
    """What a gate claims.

    Arguments:
        stochastic: draws noise (only through its noise argument).
        differentiable: gradients flow from gates to logits.
        temperature: has a setting ``temperature``; gates harden as it falls.
    """

    stochastic: bool = False
    differentiable: bool = False
    temperature: bool = False


class GateSampler(Part):
    """Samples gates in [0, 1] from trainable logits.

    The logits [M] are the whole state: the engine keeps them, trains them and hands them in. Noise is an argument, so
    sampling is a pure function. A closed gate is exactly 0.0 and a fully open one exactly 1.0; every value is
    k / num_levels.

    When the engine calls what, in every frame:

    * ``init``: once, with the propagated confidence; ``open_probability`` then says which rows take part;
    * ``noise``, ``sample(logits, noise)``, ``open_probability`` (for the price): once per iteration;
    * ``bound``: after each optimiser step on the logits;
    * ``sample(logits, None)``: at the end of each pass, to let closed rows go, and for the gate in the packet.
    """

    traits: ClassVar[GateTraits] = GateTraits()

    def claims(self) -> GateTraits:
        return self.traits

    @property
    @abstractmethod
    def num_levels(self) -> int:
        """Number of non-zero gate values, 1 (binary) to 255."""

    @abstractmethod
    def init(self, logits: torch.Tensor) -> torch.Tensor:
        """Return the logits [M] that a frame starts from, given the propagated confidence [M]."""

    @abstractmethod
    def noise(self, num_nodes: int, generator: torch.Generator) -> torch.Tensor | None:
        """Return noise [M] for one training step, or None for a deterministic sampler."""

    @abstractmethod
    def sample(self, logits: torch.Tensor, noise: torch.Tensor | None) -> torch.Tensor:
        """Return the gates [M] in [0, 1]; differentiable in ``logits`` unless the gates are constant."""

    @abstractmethod
    def open_probability(self, logits: torch.Tensor) -> torch.Tensor:
        """Return the probability [M] that a gate is not zero; differentiable."""

    @abstractmethod
    def bound(self, logits: torch.Tensor) -> torch.Tensor:
        """Return the logits projected into the bounds that the part keeps them in; say in its settings which they are.
        """
