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

from typing import TYPE_CHECKING, Literal

import pluggy
from pydantic import BaseModel, ConfigDict, Field

from gsstream import API_VERSION
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


class ComponentSpec(BaseModel):
    """One part, described without importing it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Kind = Field(description="which slot the part fits")
    name: str = Field(pattern=r"^[a-z][a-z0-9_-]*$", description="name used in recipes and on the command line")
    target: str = Field(pattern=r"^[\w.]+:\w+$", description="'module:Class', imported on first use")
    summary: str = Field(description="one line for listings")
    api: str = Field(default=API_VERSION, pattern=r"^\d+\.\d+$", description="plugin interface it was written for")


class MethodSpec(BaseModel):
    """A named method: a recipe shipped as data inside a package."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str = Field(pattern=r"^[a-z][a-z0-9_-]*$", description="name used by --method")
    recipe: str = Field(pattern=r"^[\w.]+:[\w./-]+$", description="'package:path/inside/it.yaml'")
    summary: str = Field(description="one line for listings")
    api: str = Field(default=API_VERSION, pattern=r"^\d+\.\d+$", description="plugin interface it was written for")


class CommandSpec(BaseModel):
    """A command of ``gsstream``, described without importing it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str = Field(pattern=r"^[a-z][a-z0-9-]*$", description="what is typed after 'gsstream'")
    target: str = Field(
        pattern=r"^[\w.]+:\w+$",
        description="'module:function' that typer understands, or 'module:app' of a typer.Typer; imported on first use",
    )
    summary: str = Field(description="one line for 'gsstream --help', the first of the command's own help")
    group: str = Field(default="Further commands", min_length=1, description="heading in 'gsstream --help'")
    api: str = Field(default=API_VERSION, pattern=r"^\d+\.\d+$", description="plugin interface it was written for")
