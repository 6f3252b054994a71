"""Part: the base class of all kinds of parts. Abstract or final; configured once; no mutable state."""

from __future__ import annotations

from abc import ABC
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, TypeVar, cast

from pydantic import BaseModel, ConfigDict


class PartConfig(BaseModel):
    """Base of every part's nested ``Config``: frozen, unknown keys refused, defaults validated."""

    model_config = ConfigDict(frozen=True, extra="forbid", validate_default=True)


@dataclass(frozen=True, slots=True)
class Traits:
    """What a part claims about itself. Each kind that has claims extends this record in its own room (``GateTraits``).

    The contract kit runs the checks of each claimed trait; the checks of other traits are reported as skipped.
    """


T = TypeVar("T")
ConfigT = TypeVar("ConfigT", bound=PartConfig)
ConfigT_co = TypeVar("ConfigT_co", covariant=True)


class _Configured(Protocol[ConfigT_co]):
    """Anything with a nested ``Config``."""

    @property
    def Config(self) -> type[ConfigT_co]: ...


class Part(ABC):  # noqa: B024 - each kind adds what is abstract
    """A swappable part. Subclasses are abstract or final and nest a ``Config``.

    State and noise are arguments and results, never attributes: after construction no attribute may be set.

    ``source``: origin of the idea, for listings: a citation such as ``"S2GS, section 3.2"``, or the name of the
    distribution that had it first.

    ``processor_only``: why the part cannot work with tensors of a GPU; empty where it can. A run with such a part
    renders on the processor.

    ``denied``: checks of the contract kit that the part cannot pass -> why not, in 20 characters or more. They are made
    all the same and must fail: a denial that is no longer true is itself a failure.
    """

    Config: ClassVar[type[PartConfig]] = PartConfig
    source: ClassVar[str] = ""
    processor_only: ClassVar[str] = ""
    traits: ClassVar[Traits] = Traits()
    denied: ClassVar[Mapping[str, str]] = MappingProxyType({})
    if TYPE_CHECKING:

        @property
        def config(self: _Configured[ConfigT]) -> ConfigT:
            """The settings, an instance of the part's own ``Config``."""

    __slots__ = ("config",)

    def __init__(self, config: PartConfig | None = None) -> None:
        object.__setattr__(self, "config", self.Config() if config is None else config)

    def claims(self) -> Traits:
        """Return the traits of this part as it is configured; override where a setting changes a claim."""
        return self.traits

    def denials(self) -> Mapping[str, str]:
        """Return ``denied`` of this part as it is configured; override where a setting breaks a promise."""
        return self.denied

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(
            f"{type(self).__name__} is frozen and cannot keep {name!r}: state is passed in and returned. What needs "
            "memory is a motion, by follow(), or a streaming_method"
        )

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and self.config == other.config

    def __hash__(self) -> int:
        return hash((type(self), self.config))

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.config!r})"

    def __reduce__(self) -> tuple[Any, ...]:
        return (type(self), (self.config,))


def unwrapped(part: T) -> T:
    """Return a part, or what one has opened, without the guard that the engine may have put around it.

    For a part that does something faster with another one of its own distribution, which it has to recognise.
    """
    return cast("T", getattr(part, "__wrapped__", part))
