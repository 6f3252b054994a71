"""Part: what the five kinds have in common. Abstract or final; configured once; no mutable state."""

from __future__ import annotations

from abc import ABC
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict

from gsstream.core.auto import AutoRule


class PartConfig(BaseModel):
    """Base of every part's nested ``Config``: frozen, unknown keys refused, defaults validated."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True)


@dataclass(frozen=True, slots=True)
class Traits:
    """What a part claims about itself; the contract kit checks every claim and reports every claim denied.

    Arguments:
        stochastic: draws noise (only through its noise argument).
        differentiable: gradients flow from output to input.
        conservative: (propagation) no node is less suspect than its most suspect Gaussian.
        idempotent: applying it twice equals applying it once.
        needs_renderer: (confidence) asks the context for screen gradients.
        reduction: (regularizer) "mean" or "sum" over Gaussians.
        weights: (regularizer) settings that its terms are proportional to.
        gate_terms: (regularizer) terms that price gates alone: no residual changes them.
        floor: (confidence) largest logit of a Gaussian that nobody sees, or of a scene that stands still.
        finds_motion: (confidence) ranks what moved above what did not.
        monotone_in_change: (confidence) a stronger change never makes what changed less suspect.
        brightness: (confidence) largest mean logit of a still scene that becomes brighter by a fiftieth of full scale;
            None: no promise.
        normalised: (propagation) keeps the scale: constants stay constant, the flat structure changes nothing.
        parent_bound: (propagation) no node is less suspect than its children.
        local: (structure) the members of a node lie within one root cell of each other, along every axis.
        temperature: (gate) has a setting ``temperature``; gates harden as it falls.
    """

    stochastic: bool = False
    differentiable: bool = False
    conservative: bool = False
    idempotent: bool = False
    needs_renderer: bool = False
    reduction: str = "mean"
    weights: tuple[str, ...] = ()
    gate_terms: tuple[str, ...] = ()
    floor: float = 0.0
    finds_motion: bool = False
    monotone_in_change: bool = False
    brightness: float | None = None
    normalised: bool = False
    parent_bound: bool = False
    local: bool = False
    temperature: bool = False


class Part(ABC):
    """A swappable part. Subclasses are abstract or final and nest a ``Config``.

    State and noise are arguments and results, never attributes: after construction no attribute may be set.

    ``auto_rules``: settings that a recipe may leave to the scene by saying ``auto``, and the rule that chooses each, in
    the order in which they choose. A nested setting is written with dots. A part is never built with ``auto`` in its
    settings: until the scene is known it has its defaults there.
    """

    Config: ClassVar[type[PartConfig]] = PartConfig
    traits: ClassVar[Traits] = Traits()
    auto_rules: ClassVar[Mapping[str, AutoRule]] = MappingProxyType({})
    config: Any

    __slots__ = ("config",)

    def __init__(self, config: PartConfig | None = None) -> None:
        object.__setattr__(self, "config", self.Config() if config is None else config)

    def claims(self) -> Traits:
        """The traits of this part as it is configured; override where a setting changes a claim."""
        return self.traits

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(f"{type(self).__name__} is frozen: state is passed in and returned, never kept ({name!r})")

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and self.config == other.config

    def __hash__(self) -> int:
        return hash((type(self), self.config))

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.config!r})"

    def __reduce__(self) -> tuple[Any, ...]:
        return (type(self), (self.config,))
