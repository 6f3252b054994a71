"""What a command promises, looked at without running it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from gsstream.discovery.catalog import Catalog, Entry
from gsstream.discovery.commands import command_of
from gsstream.spec import CommandSpec
from gsstream.testing.common import imports_torch
from gsstream.testing.registry import check


class CommandUnderTest:
    """A declared command; errors name the distribution ``origin``."""

    def __init__(self, spec: CommandSpec, origin: str = "here") -> None:
        self.spec, self._origin = spec, origin

    def __repr__(self) -> str:
        return f"command {self.spec.name}"

    def made(self) -> Any:
        """Return the command that typer makes of the declaration. Raises PluginUnavailable."""
        entry = Entry(self.spec, self._origin, self._origin, "")
        return command_of(self.spec, Catalog({("command", self.spec.name): entry}, ()))


@check("command")
def check_command(subject: CommandUnderTest) -> None:
    """Typer makes a command of it that explains every option; its help begins with its summary and needs no torch."""
    command = subject.made()
    first = (command.help or "").strip().splitlines()[:1]
    assert first == [subject.spec.summary], f"its help begins with {first}, its summary is {subject.spec.summary!r}"
    silent = [f"{name} {option.name}" for name, option in _options(command) if not getattr(option, "help", None)]
    assert not silent, f"these options have no help: {', '.join(silent)}"
    module = subject.spec.target.partition(":")[0]
    heavy = imports_torch(module)
    assert not heavy, f"importing {module}, which --help does, imports torch; import it inside the function: {heavy}"


def _options(command: Any) -> Iterator[tuple[str, Any]]:
    """Every option and argument of a command and of those below it."""
    yield from ((command.name, option) for option in command.params)
    for below in getattr(command, "commands", {}).values():
        yield from _options(below)
