"""Groups of options that several of these commands have. Imports nothing heavy."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from gsstream.cli import options


@dataclass(frozen=True)
class RecordingOptions:
    """A recording, and what it needs in every recipe."""

    source: Annotated[str, typer.Option("--source", help="demo, synthetic:K=V&..., DIR, or LAYOUT:DIR.")]
    recipe: Annotated[
        Path | None, typer.Option("--recipe", help="YAML file with what the recording needs, for all methods.")
    ] = None
    settings: options.Settings = None
    frames: Annotated[int | None, typer.Option("--frames", help="Number of frames; default: all, in pilots 5.")] = None
    scale: options.Scale = None

    def changes(self) -> dict[str, Any]:
        """Return recipe key -> value of ``--set``. Raises RecipeError for one that is not KEY=VALUE."""
        from gsstream.recipe.document import read_override

        return {".".join(path): leaf.value for path, leaf in map(read_override, self.settings or ())}


@dataclass(frozen=True)
class WorkerOptions:
    """Where and how many at a time."""

    workers: Annotated[
        int | None, typer.Option("--workers", min=1, help="Runs at a time; default: one for each processor.")
    ] = None
    threads: Annotated[int, typer.Option("--threads", min=1, help="Threads of each worker.")] = 1
    ray: Annotated[
        str | None,
        typer.Option("--ray", metavar="ADDRESS", help="Run on this Ray cluster (extra: ray); 'local' starts one here."),
    ] = None
