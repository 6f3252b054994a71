"""Commands whose options are fields of dataclasses: a group of options is declared once, and travels as one value."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import MISSING, fields, is_dataclass
from typing import Any, get_type_hints


def grouped(command: Callable[..., Any]) -> Callable[..., Any]:
    """Return the command with every parameter that is a dataclass spread out into that dataclass's fields.

    A field is annotated as an option or argument of typer is. Names must differ between the groups of one command.
    """
    hints = get_type_hints(command, include_extras=True)
    plain = list(inspect.signature(command).parameters.values())
    groups = {one.name: hints[one.name] for one in plain if is_dataclass(hints[one.name])}
    spread = [one for plain_one in plain for one in _options(plain_one, hints[plain_one.name])]

    @functools.wraps(command)
    def run(**given: Any) -> Any:
        made = {name: kind(**{f.name: given.pop(f.name) for f in fields(kind)}) for name, kind in groups.items()}
        return command(**made, **given)

    run.__signature__ = inspect.Signature(spread)  # type: ignore[attr-defined]  # what typer reads
    run.__annotations__ = {one.name: one.annotation for one in spread}
    return run


def _options(parameter: inspect.Parameter, hint: Any) -> list[inspect.Parameter]:
    if not is_dataclass(hint):
        return [parameter.replace(annotation=hint, kind=inspect.Parameter.KEYWORD_ONLY)]
    assert isinstance(hint, type), "an annotation is a class, not an instance"
    hints = get_type_hints(hint, include_extras=True)
    return [
        inspect.Parameter(
            one.name,
            inspect.Parameter.KEYWORD_ONLY,
            annotation=hints[one.name],
            default=inspect.Parameter.empty if one.default is MISSING else one.default,
        )
        for one in fields(hint)
    ]
