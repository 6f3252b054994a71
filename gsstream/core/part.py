"""Part: what the five kinds have in common. Abstract or final; configured once; no mutable state."""

from __future__ import annotations

from abc import ABC
from dataclasses import dataclass
from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict


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
        stable: (structure) an identity edit changes nothing and co-members stay together.
        needs_renderer: (confidence) asks the context for screen gradients.
        reduction: (regularizer) "mean" or "sum" over Gaussians.
    """

    stochastic: bool = False
    differentiable: bool = False
    conservative: bool = False
    idempotent: bool = False
    stable: bool = False
    needs_renderer: bool = False
    reduction: str = "mean"


class Part(ABC):
    """A swappable part. Subclasses are abstract or final and nest a ``Config``.

    State and noise are arguments and results, never attributes: after construction no attribute may be set.
    """

    Config: ClassVar[type[PartConfig]] = PartConfig
    traits: ClassVar[Traits] = Traits()
    config: Any

    __slots__ = ("config",)

    def __init__(self, config: PartConfig | None = None) -> None:
        object.__setattr__(self, "config", self.Config() if config is None else config)

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
