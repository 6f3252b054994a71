"""GateSampler: the share of the residual that a node lets through."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar, final

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


@final
@dataclass(frozen=True, slots=True)
class AnalyticGate:
    """Closed form of a gate without noise: a sigmoid rounded to levels, straight-through.

    Arguments:
        temperature: the soft gate is sigmoid(logit / temperature + logit_offset).
        levels: non-zero values that it is rounded to; its gradient is that of the soft gate.
        open_logit: logit at which a gate is open with probability one half; it is sigmoid(logit - open_logit).
        bound: logits are kept within -bound to bound; infinity: they are not.
        logit_offset: 100 makes a gate that is always open, whatever its logit, and has no gradient.
    """

    temperature: float
    levels: int
    open_logit: float
    bound: float
    logit_offset: float = 0.0

    def gates(self, logits: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the gates [M] of logits [M], and their derivatives."""
        x = logits / self.temperature + self.logit_offset
        soft = torch.sigmoid(x)
        # Divided by a tensor, as the decoder divides: a product with 1 / levels would be another number.
        levels = soft.new_full((), float(self.levels))
        return torch.round(soft * levels) / levels, soft * torch.sigmoid(-x) / self.temperature

    def probability(self, logits: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the probabilities [M] that gates are open, and their derivatives by the logits [M]."""
        x = logits - self.open_logit
        open_probability = torch.sigmoid(x)
        return open_probability, open_probability * torch.sigmoid(-x)


@final
@dataclass(frozen=True, slots=True)
class SampledGate:
    """A gate that is sampled by calls of the part alone."""


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
        """Return the logits projected into the part's bounds, which its settings name."""

    def form(self) -> AnalyticGate | SampledGate:
        """Return the closed form of this gate as it is configured, where it is that of :class:`AnalyticGate`.

        A compiled optimiser may use it in its inner loop instead of calling the part.
        """
        return SampledGate()
