"""Groups of options that several of these commands have. Imports nothing heavy."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gsstream.cli import options

if TYPE_CHECKING:
    from gsstream_lab.jobs.base import Executor, Work
    from gsstream_lab.sweep.config import Scene


@dataclass(frozen=True)
class RecordingOptions:
    """A recording, and what it needs in every recipe."""

    source: Annotated[str, typer.Option("--source", help="demo, synthetic:K=V&..., DIR, or LAYOUT:DIR.")]
    recipe: Annotated[
        Path | None,
        typer.Option(
            "--recipe",
            metavar="FILE|recording:NAME",
            help="What the recording needs, for all methods: a YAML file, or one of gsstream's own.",
        ),
    ] = None
    settings: options.Settings = None
    frames: Annotated[int | None, typer.Option("--frames", help="Number of frames; default: all, in pilots 5.")] = None
    scale: options.Scale = None

    def scene(self, frames: int | None = None) -> Scene:
        """Return the recording as the scene of a sweep. Raises RecipeError for a ``--set`` that is not KEY=VALUE."""
        from gsstream.recipe.document import read_override
        from gsstream.recipe.shipped import recipe_file
        from gsstream_lab.sweep.config import Scene

        return Scene(
            name=scene_name(self.source),
            uri=self.source,
            scale=self.scale,
            frames=self.frames or frames,
            recipe=None if self.recipe is None else str(recipe_file(self.recipe).resolve()),
            set={".".join(path): leaf.value for path, leaf in map(read_override, self.settings or ())},
        )

    def next_command(self, recipe: Path, out: Path) -> str:
        """Return the command that encodes the whole recording with a recipe, ready for a shell."""
        from gsstream_lab.jobs.folder import recording_uri

        source = recording_uri(self.source, None)
        return shlex.join(["gsstream", "run", "--source", source, "--recipe", str(recipe), "--out", str(out)])


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

    def executor(self, work: Work | None = None) -> Executor:
        """Return workers that do ``work``; None: that run the cells of one sweep."""
        from gsstream_lab.jobs.executor import make_executor
        from gsstream_lab.sweep.job import run_job

        return make_executor(work or run_job, self.workers, self.threads, self.ray)


def progress(quiet: bool) -> Callable[[str], Any]:
    """Return what takes the lines that a sweep prints while it works."""
    return (lambda _: None) if quiet else typer.echo


def scene_name(source: str) -> str:
    """Return what tables call a recording: the last part of its URI, or the name of its source."""
    scheme, _, rest = source.partition("?")[0].partition(":")
    last = Path(rest or scheme).name if "=" not in rest else scheme
    return re.sub(r"[^\w.+-]", "-", last, flags=re.ASCII).lstrip("_.+-") or "recording"
