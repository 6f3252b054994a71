"""Declares a command that gsstream has, beside one of its own."""

from gsstream.spec import CommandSpec, hookimpl


@hookimpl
def gsstream_commands():
    return [
        CommandSpec(name="mine", target="nowhere:mine", summary="A command."),
        CommandSpec(name="run", target="nowhere:run", summary="Another run."),
    ]
