"""The table check -> saboteur."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar, final

from gsstream.core.part import Part
from gsstream.testing.registry import SourceUnderTest

Saboteur = TypeVar("Saboteur", bound=type)

SABOTEURS: dict[str, Callable[[], Part | SourceUnderTest]] = {}


def spoils(check: str, *, leave: bool = False) -> Callable[[Any], Any]:
    """Enter a class as the saboteur of a check. Its docstring says what is wrong with it.

    ``leave`` keeps the class as it is; otherwise it is made final, as checks demand.
    """

    def enter(cls: Saboteur) -> Saboteur:
        assert check not in SABOTEURS, check
        SABOTEURS[check] = cls
        return cls if leave else final(cls)

    return enter
