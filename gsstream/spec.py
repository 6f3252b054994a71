"""What a plugin declares. Imports no torch: listing plugins stays cheap.

A plugin is a module named by an entry point of the group ``gsstream``::

    # pyproject.toml
    [project.entry-points.gsstream]
    mine = "gsstream_mine.plugin"

    # gsstream_mine/plugin.py
    from gsstream.spec import ComponentSpec, hookimpl

    @hookimpl
    def gsstream_components():
        return [ComponentSpec(kind="gate", name="mine", target="gsstream_mine.gate:MyGate", summary="...")]
"""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import pluggy
from pydantic import ConfigDict, Field, ModelWrapValidatorHandler, ValidationError, model_validator
from pydantic.dataclasses import dataclass

from gsstream import API_VERSION
from gsstream.core import versions
from gsstream.core.kinds import PART_KINDS

__all__ = [
    "API_VERSION", "ENTRY_POINT_GROUP", "KINDS", "CommandSpec", "ComponentSpec", "Kind", "MethodSpec", "hookimpl",
    "hookspec",
]  # fmt: skip


def __dir__() -> list[str]:
    return __all__


ENTRY_POINT_GROUP = "gsstream"
if TYPE_CHECKING:
    Kind = str
else:
    Kind = Literal[tuple(PART_KINDS)]
#: Kinds of declarations that a listing names: a kind of part, a named method (a recipe), or a command.
KINDS: tuple[str, ...] = (*PART_KINDS, "method", "command")

hookspec = pluggy.HookspecMarker("gsstream")
hookimpl = pluggy.HookimplMarker("gsstream")


_T = TypeVar("_T")
_STRICT = ConfigDict(extra="forbid")


def _with_fields(cls: type[_T]) -> type[_T]:
    """Add the fields and what they mean to the docstring of a declaration, which is what ``help`` shows."""
    said = (f"    {field.name}: {field.default.description}" for field in fields(cls))  # type: ignore[arg-type, union-attr]
    cls.__doc__ = f"{cls.__doc__}\n\nArguments:\n" + "\n".join(said)
    return cls


@dataclass(frozen=True, kw_only=True, config=_STRICT)
class _Declaration:
    """What the declarations have in common: one that cannot be read and has another version is refused for that."""

    if not TYPE_CHECKING:

        @model_validator(mode="wrap")
        @classmethod
        def _version_first(cls, given: Any, read: ModelWrapValidatorHandler[Any]) -> Any:
            try:
                return read(given)
            except ValidationError:
                said = getattr(given, "kwargs", None) or {}
                problem = versions.version_problem("component API", str(said.get("api", API_VERSION)), API_VERSION)
                if problem is None:
                    raise
                raise ValueError(f"{said.get('name', cls.__name__)}: {problem}") from None


@_with_fields
@dataclass(frozen=True, kw_only=True, config=_STRICT)
class ComponentSpec(_Declaration):
    """One part, described without importing it."""

    kind: Kind = Field(description="which slot the part fits")
    name: str = Field(pattern=r"^[a-z][a-z0-9_-]*$", description="name used in recipes and on the command line")
    target: str = Field(pattern=r"^[\w.]+:\w+$", description="'module:Class', imported on first use")
    summary: str = Field(description="one line for listings")
    api: str = Field(default=API_VERSION, pattern=r"^\d+\.\d+$", description="plugin interface it was written for")


@_with_fields
@dataclass(frozen=True, kw_only=True, config=_STRICT)
class MethodSpec(_Declaration):
    """A named method: a recipe shipped as data inside a package."""

    name: str = Field(pattern=r"^[a-z][a-z0-9_-]*$", description="name used by --method")
    recipe: str = Field(pattern=r"^[\w.]+:[\w./-]+$", description="'package:path/inside/it.yaml'")
    summary: str = Field(description="one line for listings")
    api: str = Field(default=API_VERSION, pattern=r"^\d+\.\d+$", description="plugin interface it was written for")


@_with_fields
@dataclass(frozen=True, kw_only=True, config=_STRICT)
class CommandSpec(_Declaration):
    """A command of ``gsstream``, described without importing it."""

    name: str = Field(pattern=r"^[a-z][a-z0-9-]*$", description="what is typed after 'gsstream'")
    target: str = Field(
        pattern=r"^[\w.]+:\w+$",
        description="'module:function' that typer understands, or 'module:app' of a typer.Typer; imported on first use",
    )
    summary: str = Field(description="one line for 'gsstream --help', the first of the command's own help")
    group: str = Field(default="Further commands", min_length=1, description="heading in 'gsstream --help'")
    api: str = Field(default=API_VERSION, pattern=r"^\d+\.\d+$", description="plugin interface it was written for")
