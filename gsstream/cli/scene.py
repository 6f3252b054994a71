"""``gsstream scene``: make a scene from raw recordings, and find faults of a scene."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gsstream.cli import options
from gsstream.cli.working import working
from gsstream.core.errors import InputError
from gsstream.core.install_hints import page

if TYPE_CHECKING:
    from gsstream.input.prepare.findings import Finding
    from gsstream.input.prepare.prepare import Prepared

app = typer.Typer(
    help="Prepare and validate scenes.", no_args_is_help=True, rich_markup_mode=None, add_completion=False
)


@app.callback()
def _group() -> None:
    """Prepare and validate scenes."""


@app.command()
def prepare(
    raw: Annotated[
        str,
        typer.Argument(
            help="A folder of pictures or a video per camera, a picture per camera, or what --source of 'run' reads."
        ),
    ],
    out: Annotated[Path, typer.Option("--out", help="Folder of the scene; must be empty or missing.")],
    test: Annotated[
        list[str] | None,
        typer.Option("--test", metavar="ID", help="Camera that tests only, out of poses and points; repeatable."),
    ] = None,
    lens: Annotated[
        str, typer.Option("--lens", help="pinhole, simple-radial, radial, opencv or opencv-fisheye.")
    ] = "simple-radial",
    each: Annotated[bool, typer.Option("--each", help="A lens per camera; else all cameras share one.")] = False,
    frames: Annotated[int | None, typer.Option("--frames", help="Frames to take over; all by default.")] = None,
    width: Annotated[int | None, typer.Option("--width", help="Shrink pictures to this width.")] = None,
    fps: Annotated[float | None, typer.Option("--fps", help="Frames per second, where RAW does not say.")] = None,
    without: Annotated[
        list[str] | None, typer.Option("--without", metavar="ID", help="Camera that is left out; repeatable.")
    ] = None,
    quiet: options.Quiet = False,
) -> None:
    """Make a validated scene from raw synchronised recordings: poses, pinhole pictures, points, a report.

    Poses and lenses are those that RAW gives, in any layout that 'run' reads, else recovered from frame 0. Needs
    gsstream[sfm]. Exit code 2 when the scene was made but its validation found an error.
    """
    import time

    from gsstream.input.prepare.prepare import PrepareOptions
    from gsstream.input.prepare.prepare import prepare as make
    from gsstream.input.prepare.report import write_report
    from gsstream.input.prepare.validate import validate as find
    from gsstream.input.recordings.open import open_source

    began = time.perf_counter()
    model = lens.upper().replace("-", "_")
    options = PrepareOptions(
        test=tuple(test) if test else None,
        without=tuple(without or ()),
        model=model,
        each=each,
        frames=frames,
        width=width,
        fps=fps,
    )
    with working("reading pictures", quiet) as display:
        made = make(raw, out, options, say=lambda line: None if quiet else typer.echo(line), tell=display.tell)
        display.tell("checking the scene")
        # The features have just been matched; how well they fit is in the report.
        found = find(lambda scale: open_source(str(out), scale), features=False, say=display.tell)
        written = write_report(out, made, found, time.perf_counter() - began)
    _tell(made, found)
    if not quiet:
        typer.echo("\n".join(f"wrote {path}" for path in (out / "cameras.json", *written)))
    if any(finding.severity == "error" for finding in found):
        raise typer.Exit(2)


def _tell(made: Prepared, found: list[Finding]) -> None:
    """Lines that a user has to know about the scene that was made."""
    for finding in found:
        typer.echo(f"{finding.severity}: [{finding.code}] {finding.message}", err=True)
    if made.points is None:
        typer.echo(
            "warning: the pictures share too few features for points, so nothing is known of how well the poses fit; "
            "a run searches for points of its own",
            err=True,
        )
    if made.left_out:
        typer.echo(f"warning: no pose was found for {', '.join(made.left_out)}; they are left out", err=True)


@app.command()
def validate(
    scene: Annotated[str, typer.Argument(help="Recording: a folder, or whatever --source of 'run' takes.")],
    frames: Annotated[int, typer.Option("--frames", help="Frames, from the first, whose pictures are compared.")] = 60,
    no_features: Annotated[
        bool, typer.Option("--no-features", help="Do not match features between cameras (most of the time).")
    ] = False,
) -> None:
    """Say what is wrong with a scene, and what to do. Exit code 2 when a run would be wasted on it."""
    from gsstream.discovery.catalog import load_catalog
    from gsstream.engine.run.recording import open_recording
    from gsstream.input.prepare.findings import CHECKS
    from gsstream.input.prepare.validate import validate as find
    from gsstream.recipe.model import Recipe

    if frames < 1:
        raise InputError(f"--frames: expected at least 1, got {frames}")
    catalog = load_catalog()
    with working("checking the scene") as display:
        found = find(
            lambda scale: open_recording(scene, Recipe(scale=scale), catalog),
            frames=frames,
            features=not no_features,
            say=display.tell,
        )
    for finding in found:
        typer.echo(f"{finding.severity}: [{finding.code}] {finding.message}")
    errors = sum(finding.severity == "error" for finding in found)
    if errors:
        checks = page("reference/scene-checks.md")
        typer.echo(f"{scene}: {errors} error{'s' if errors > 1 else ''}; all checks: {checks}")
        raise typer.Exit(2)
    blind = {finding.code for finding in found if finding.severity == "note"} | ({"epipolar"} if no_features else set())
    done = f"{len(CHECKS) - len(blind)} checks" + (f"; not checked: {', '.join(sorted(blind))}" if blind else "")
    remarks = sum(finding.severity == "warning" for finding in found)
    typer.echo(f"{scene}: {f'{remarks} remark(s)' if remarks else 'fine'} ({done})")
