"""Options that several commands have, each spelled once, and what they change in a recipe. Imports nothing heavy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

Source = Annotated[
    str, typer.Option("--source", help="demo, synthetic:K=V&..., watch:DIR, DIR, LAYOUT:DIR, s3://BUCKET/DIR.")
]
Out = Annotated[str, typer.Option("--out", help="Output folder, or s3://BUCKET/DIR; must not hold another run.")]
Serve = Annotated[
    int | None,
    typer.Option("--serve", metavar="PORT", min=0, max=65535, help="Show the frames live at this port (extra: serve)."),
]
Recipes = Annotated[
    list[Path] | None,
    typer.Option(
        "--recipe",
        metavar="FILE|recording:NAME",
        help="YAML file with differences from the method's recipe, or one of gsstream's own (recording:n3dv, "
        "recording:live ...); repeatable, last wins.",
    ),
]
Settings = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY.PATH=VALUE", help="Change a value, e.g. gate.temperature=0.3; repeatable."),
]
BUDGET = typer.Option("--budget", metavar="LIMITS", help="Any of time=1.0s,size=20KB,rate=2Mbit/s,memory=2GB.")
Scale = Annotated[float | None, typer.Option("--scale", help="Shrink images by this factor in (0, 1].")]
FirstFrame = Annotated[
    Path | None, typer.Option("--first-frame", help="Take frame 0 over from this stream, do not reconstruct it.")
]
Quiet = Annotated[bool, typer.Option("--quiet", help="Print only warnings and errors.")]


@dataclass(frozen=True)
class RecipeOptions:
    """The recipe of a command line, and the settings that the command line changes."""

    method: Annotated[
        str | None, typer.Option("--method", help="Method (see 'gsstream methods'); by default the recipe file's.")
    ] = None
    recipe: Recipes = None
    settings: Settings = None
    budget: Annotated[str | None, BUDGET] = None
    frames: Annotated[int | None, typer.Option("--frames", help="Number of frames; all by default.")] = None
    scale: Scale = None
    renderer: Annotated[
        str | None, typer.Option("--renderer", help="auto: a GPU where one works; cpu, gsplat or reference.")
    ] = None

    def overrides(self) -> list[tuple[str, str]]:
        """Return the changes as (option, KEY.PATH=VALUE), the short options last."""
        return overrides(
            self.settings, budget=self.budget, frames=self.frames, scale=self.scale, renderer=self.renderer
        )


@dataclass(frozen=True)
class ShownOptions:
    """Options that say what is shown of a run besides the stream."""

    no_video: Annotated[bool, typer.Option("--no-video", help="Write no video, only still pictures.")] = False
    no_pictures: Annotated[
        bool, typer.Option("--no-pictures", help="Write no contact sheet, plots or video, only the summary as text.")
    ] = False
    quiet: Quiet = False

    def wanted(self) -> dict[str, bool]:
        """Return the arguments of ``write_gallery``."""
        return {"pictures": not self.no_pictures, "video": not self.no_video}


def overrides(settings: Sequence[str] | None, *, budget: str | None = None, **short: object) -> list[tuple[str, str]]:
    """Return the changes of a recipe on a command line as (option, KEY.PATH=VALUE), those of short options last.

    ``short``: recipe key -> value of an option of that name; None: not given.
    """
    from gsstream.recipe.budget import budget_overrides

    changes = [("--set", text) for text in settings or ()]
    changes += budget_overrides(budget) if budget is not None else []
    return changes + [(f"--{key}", f"{key}={value}") for key, value in short.items() if value is not None]
