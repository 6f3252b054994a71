"""The hooks a plugin may implement; each returns a list of specs."""

from __future__ import annotations

from gsstream.spec import CommandSpec, ComponentSpec, MethodSpec, hookspec


@hookspec
def gsstream_components() -> list[ComponentSpec]:
    """Return the parts this plugin ships."""
    raise NotImplementedError


@hookspec
def gsstream_methods() -> list[MethodSpec]:
    """Return the named methods (recipes) this plugin ships."""
    raise NotImplementedError


@hookspec
def gsstream_commands() -> list[CommandSpec]:
    """Return the commands that this plugin adds to ``gsstream``."""
    raise NotImplementedError
