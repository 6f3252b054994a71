"""None: no residual is sent; motion and growth alone change the scene."""

from __future__ import annotations

from collections.abc import Mapping
from typing import final

from gsstream.parts.residual.layout import AttributeCode
from gsstream.parts.update.base import Scope, UpdateRule


@final
class NoUpdate(UpdateRule):
    """Sends no residual: what is there keeps its attributes (the null part)."""

    source = "gsstream"

    def scope(self, frame: int) -> Scope:
        return Scope.NONE

    def codes(self) -> Mapping[str, AttributeCode]:
        return {}
