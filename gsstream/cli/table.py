"""The table of commands: gsstream's own and those of plugins; each is imported when it is called."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command

from gsstream.core.errors import PluginUnavailable
from gsstream.core.install_hints import install_part
from gsstream.discovery.builtin import gsstream_commands
from gsstream.discovery.catalog import Catalog, Entry, load_catalog
from gsstream.discovery.commands import command_of
from gsstream.spec import CommandSpec

#: Headings of ``gsstream --help`` that come first, in this order; those of plugins follow.
GROUPS = ("Encode", "Watch", "Evaluate", "Extend")


class CommandTable(TyperGroup):
    """A group whose commands come from declarations (:class:`gsstream.spec.CommandSpec`).

    gsstream's own commands are found without looking for plugins. A plugin that cannot be loaded costs its own commands
    alone: they are missing here, and asking for one says why. So does asking for one that this project ships elsewhere.
    """

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings)
        self._own = {spec.name: spec for spec in gsstream_commands()}
        self._catalog: Catalog | None = None

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of all commands, in the order of ``--help``."""
        return [spec.name for _, specs in self._sections() for spec in specs]

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Import a command.

        Raises PluginUnavailable when its plugin is in quarantine, or it is not what the declaration says.
        """
        if cmd_name in self.commands:
            return self.commands[cmd_name]
        if (own := self._own.get(cmd_name)) is not None:
            found = command_of(own, Catalog({("command", own.name): Entry(own, "builtin", "gsstream", "")}, ()))
        elif (spec := self._others().get(cmd_name)) is not None:
            found = command_of(spec, self._plugins())
        else:
            self._say_what_is_missing(cmd_name)
            return None
        self.commands[cmd_name] = found
        return found

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find the command of a line; a name that is not one is answered with the nearest that is."""
        if args and args[0] not in self._own and self.get_command(ctx, args[0]) is None:
            names = [*self._own, *self._others()]
            # Typer suggests similar commands from these names; no command is imported for the suggestion.
            self.commands.update({name: TyperCommand(name) for name in names if name not in self.commands})
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write one section of the help for each group, from the declarations alone."""
        width = max(len(name) for name in self.list_commands(ctx))
        for heading, specs in self._sections():
            with formatter.section(heading):
                formatter.write_dl([(spec.name.ljust(width), spec.summary) for spec in specs])

    def _sections(self) -> Iterator[tuple[str, list[CommandSpec]]]:
        specs = [*self._own.values(), *self._others().values()]
        for heading in (*GROUPS, *sorted({spec.group for spec in specs} - set(GROUPS))):
            yield heading, [spec for spec in specs if spec.group == heading]

    def _plugins(self) -> Catalog:
        if self._catalog is None:
            self._catalog = load_catalog()
        return self._catalog

    def _others(self) -> dict[str, CommandSpec]:
        return {spec.name: spec for spec in _specs(self._plugins()) if spec.name not in self._own}

    def _say_what_is_missing(self, name: str) -> None:
        for plugin in self._plugins().quarantine:
            if any(isinstance(spec, CommandSpec) and spec.name == name for spec in plugin.declared):
                raise plugin.unavailable(f"the command {name!r}") from plugin.error
        cure = install_part("command", name)
        if cure is not None and not any(plugin.left_out for plugin in self._plugins().plugins):
            raise PluginUnavailable(f"the command {name!r} is not installed here. To install it: {cure}")


def _specs(catalog: Catalog) -> Iterable[CommandSpec]:
    return (entry.spec for entry in catalog.entries.values() if isinstance(entry.spec, CommandSpec))


def whole_table(app: typer.Typer) -> CommandTable:
    """Return an app's table with every command imported, those of healthy plugins too; slow."""
    table = get_command(app)
    assert isinstance(table, CommandTable), "the app was made with cls=CommandTable"
    for name in table.list_commands(None):
        table.get_command(None, name)
    return table
