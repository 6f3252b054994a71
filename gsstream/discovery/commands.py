"""From the declaration of a command to the command that typer runs."""

from __future__ import annotations

from typing import Any

import typer
from typer.main import get_command

from gsstream.core.errors import STRANGERS, PluginUnavailable
from gsstream.discovery.catalog import Catalog
from gsstream.spec import CommandSpec


def command_of(spec: CommandSpec, catalog: Catalog) -> Any:
    """Import the function that a declaration names, and make a command of it.

    Raises PluginUnavailable when it cannot be imported, or typer can make nothing of its parameters.
    """
    target = catalog.resolve("command", spec.name)
    app = target
    if not isinstance(target, typer.Typer):
        app = typer.Typer(add_completion=False, rich_markup_mode=None)
        app.command(name=spec.name)(target)
    try:
        command = get_command(app)
    except STRANGERS as error:  # third-party code: any failure is reported with its owner's name
        origin = catalog.entry("command", spec.name).origin
        raise PluginUnavailable(f"command {spec.name!r} (from {origin}) cannot be used: {error}") from error
    command.name = spec.name
    return command
