"""Declares one command that works and two whose targets are broken."""

from gsstream.spec import CommandSpec, hookimpl


def works(count: int = 2) -> None:
    """Say a number."""
    print(count)


def odd(thing: int | str) -> None:
    """Take what no command line can give."""


@hookimpl
def gsstream_commands():
    module = "gsstream_command_targets_plugin"
    return [
        CommandSpec(name="works", target=f"{module}:works", summary="Say a number.", group="Mine"),
        CommandSpec(name="absent", target="a_package_nobody_has:absent", summary="Nothing to import."),
        CommandSpec(name="odd", target=f"{module}:odd", summary="Take what no command line can give."),
    ]
