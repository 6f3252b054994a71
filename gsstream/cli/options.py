"""Options that several commands have, each spelled once, and what they change in a recipe. Imports nothing heavy."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

Out = Annotated[Path, typer.Option("--out", help="Output folder; must not hold another run.")]
Method = Annotated[
    str | None, typer.Option("--method", help="Method (see 'gsstream methods'); by default the recipe file's.")
]
Recipes = Annotated[
    list[Path] | None,
    typer.Option("--recipe", help="YAML file with differences from the method's recipe; repeatable, last wins."),
]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY.PATH=VALUE", help="Change a value, e.g. gate.temperature=0.3; repeatable."),
]
BUDGET = typer.Option(
    "--budget", metavar="LIMITS", help="Any of time=1.0s,size=20KB,rate=2Mbit/s,memory=2GB."
)
Frames = Annotated[int | None, typer.Option("--frames", help="Number of frames; all by default.")]
Scale = Annotated[float | None, typer.Option("--scale", help="Shrink images by this factor in (0, 1].")]
FirstFrame = Annotated[
    Path | None, typer.Option("--first-frame", help="Take frame 0 over from this stream, do not reconstruct it.")
]
Threads = Annotated[int, typer.Option("--threads", min=1, help="Threads of each worker.")]
Ray = Annotated[
    str | None,
    typer.Option("--ray", metavar="ADDRESS", help="Run on this Ray cluster (extra: ray); 'local' starts one here."),
]
Resume = Annotated[bool, typer.Option("--resume", help="Continue the run that --out holds.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace the run that --out holds.")]
Diagnose = Annotated[
    bool, typer.Option("--diagnose", help="Count Gaussians left behind by moving bodies, in metrics.jsonl.")
]
NoVideo = Annotated[bool, typer.Option("--no-video", help="Write no video, only still pictures.")]
NoPictures = Annotated[
    bool, typer.Option("--no-pictures", help="Write no contact sheet, plots or video, only the summary as text.")
]
Quiet = Annotated[bool, typer.Option("--quiet", help="Print only warnings and errors.")]

Serve = Annotated[
    int | None,
    typer.Option("--serve", metavar="PORT", min=0, max=65535, help="Show the frames live at this port (extra: serve)."),
]


def workers(jobs: str, default: str = "one for each processor") -> Any:
    """Return the option --workers of a command whose workers do ``jobs``."""
    return typer.Option("--workers", min=1, help=f"{jobs} at a time; default: {default}.")


def overrides(
    settings: Sequence[str] | None, *, budget: str | None = None, **short: object
) -> list[tuple[str, str]]:
    """Return what a command line changes in a recipe: (option, KEY.PATH=VALUE), the short options last.

    Arguments:
        settings: of ``--set``. budget: of ``--budget``.
        short: recipe key -> value of an option of that name; None: not given.
    """
    from gsstream.recipe.budget import budget_overrides

    changes = [("--set", text) for text in settings or ()]
    changes += budget_overrides(budget) if budget is not None else []
    return changes + [(f"--{key}", f"{key}={value}") for key, value in short.items() if value is not None]
