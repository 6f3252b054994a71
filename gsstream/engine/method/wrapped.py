"""A method as a run calls it: made of its parts, checked, within its budget, repeated where it fails."""

from __future__ import annotations

from typing import Any

from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.budget.controller import Controller
from gsstream.engine.method.budgeted import Budgeted
from gsstream.engine.method.checked import Checked
from gsstream.engine.method.parts import PartsMethod
from gsstream.engine.method.repeating import Repeating
from gsstream.method.base import StreamingMethod


def wrapped(parts: Assembly, controller: Controller) -> StreamingMethod[Any]:
    """Return the method of a recipe behind what its recipe asks for; each wrapper is a method itself."""
    own = parts.part("streaming_method")
    method: StreamingMethod[Any] = own.with_slots(parts) if isinstance(own, PartsMethod) else own  # type: ignore[assignment]
    method = Checked(method, parts)
    if controller.budget.limits_anything:
        method = Budgeted(method, controller)
    return Repeating(method) if parts.recipe.stream.on_error == "repeat" else method
