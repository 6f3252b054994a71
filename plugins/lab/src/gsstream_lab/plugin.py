"""What this plugin ships, described without importing torch."""

from __future__ import annotations

from gsstream.spec import CommandSpec, ComponentSpec, hookimpl

GROUP = "Measure"
#: name -> (function or Typer app in ``gsstream_lab.commands``, one line for ``gsstream --help``)
COMMANDS = {
    "sweep": ("sweep:sweep", "Run every recipe of a sweep on every scene with every seed."),
    "batch": ("batch:batch", "Encode every recording of a list with one method."),
    "report": ("report:report", "Write report.html (one file, no network), report.md and its figures."),
    "compare": ("compare:compare", "Encode one recording with several methods and show them side by side."),
    "evaluate-files": (
        "evaluate_files:evaluate_files",
        "Compare Gaussians or pictures of another program with the test cameras.",
    ),
    "tune": ("tune:tune", "Try a few recipes on a few frames and write the best that fits a budget as tuned.yaml."),
    "search": ("search:search", "Look for settings of a recording and write the recipe as found.yaml."),
    "gap": ("gap:gap", "Reconstruct frames of a run from their own images alone and say how much better they are."),
    "left-behind": ("left_behind:left_behind", "Count the Gaussians that stay behind the body they belong to."),
    "bench": ("bench:app", "Measure rendering or a frame step here."),
}


@hookimpl
def gsstream_components() -> list[ComponentSpec]:
    """The source that disturbs another one, for sweeps."""
    return [
        ComponentSpec(
            kind="source",
            name="disturbed",
            target="gsstream_lab.disturbed:open_disturbed",
            summary="another recording under gain, noise, lost images or clocks that are off",
        )
    ]


@hookimpl
def gsstream_commands() -> list[CommandSpec]:
    """The commands, in the order of ``gsstream --help``."""
    return [
        CommandSpec(name=name, target=f"gsstream_lab.commands.{target}", summary=summary, group=GROUP)
        for name, (target, summary) in COMMANDS.items()
    ]
