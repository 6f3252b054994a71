"""What this plugin ships, described without importing torch, PyAV or OpenCV."""

from __future__ import annotations

from gsstream.spec import CommandSpec, ComponentSpec, hookimpl

GROUP = "Capture"


@hookimpl
def gsstream_components() -> list[ComponentSpec]:
    """The source that captures and is followed in one command."""
    return [
        ComponentSpec(
            kind="source",
            name="rig",
            target="gsstream_capture.source:open_rig",
            summary="live cameras of a rig file, captured into a folder that the run follows",
        )
    ]


@hookimpl
def gsstream_commands() -> list[CommandSpec]:
    """The commands, in the order of ``gsstream --help``."""
    return [
        CommandSpec(
            name="capture",
            target="gsstream_capture.commands.capture:capture",
            summary="Write what live cameras see as a folder that 'gsstream run --source watch:' follows.",
            group=GROUP,
        ),
        CommandSpec(
            name="calibrate",
            target="gsstream_capture.commands.calibrate:app",
            summary="Find lenses and poses of a rig by pictures of a printed board, or of whatever the rig sees.",
            group=GROUP,
        ),
    ]
