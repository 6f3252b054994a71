"""A renderer that brings another loss or another row optimiser than its own."""

from __future__ import annotations

from typing import Any


class Bundle:
    """Stands for ``renderer``, with some members (``loss``, ``optimiser``) in place of those that it brings."""

    def __init__(self, renderer: Any, **members: Any) -> None:
        self.__dict__.update(members, renderer=renderer)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.__dict__["renderer"], name)
