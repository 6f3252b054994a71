"""``gsstream evaluate-files``: how good the files are that another program made of a recording."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gsstream.cli import options
from gsstream.cli.evaluate import LpipsOptions, MeasureOptions
from gsstream.cli.grouped import grouped
from gsstream.cli.streams import frame_range, progress_on
from gsstream.core.errors import InputError

if TYPE_CHECKING:
    from gsstream.input.recordings.base import SourceInfo
    from gsstream.recipe.model import Recipe
    from gsstream_lab.files import PlySequence, Renders


@grouped
def evaluate_files(
    network: LpipsOptions,
    measured: MeasureOptions,
    source: Annotated[str, typer.Option("--source", help="The recording that the files show.")],
    ply_sequence: Annotated[
        Path | None, typer.Option("--ply-sequence", help="Folder of 3DGS PLYs, one per frame.")
    ] = None,
    renders: Annotated[Path | None, typer.Option("--renders", help="Folder of pictures, CAMERA/FRAME.png.")] = None,
    files: Annotated[
        Path | None, typer.Option("--files", help="File or folder whose bytes count; default: the PLYs themselves.")
    ] = None,
    first: Annotated[int, typer.Option("--first", min=0, help="The number in a file's name that means frame 0.")] = 0,
    recipe: Annotated[
        Path | None,
        typer.Option("--recipe", metavar="FILE|recording:NAME", help="Recipe with what the recording needs."),
    ] = None,
    scale: options.Scale = None,
) -> None:
    """Compare Gaussians or pictures of another program with the test cameras.

    Say what is measured with --ply-sequence or with --renders. The numbers are those of gsstream evaluate.
    """
    from gsstream.discovery.catalog import load_catalog
    from gsstream.engine.run.recording import open_recording
    from gsstream.evaluation.evaluate import evaluate_frames
    from gsstream.recipe.load import resolve_recipe
    from gsstream_lab.files import bytes_line

    if (ply_sequence is None) == (renders is None):
        raise InputError("expected one of --ply-sequence DIR and --renders DIR, to say what is evaluated")
    lpips, (low, high) = network.load(), frame_range(measured.frames)
    catalog = load_catalog()
    given = [] if recipe is None else [recipe]
    found = resolve_recipe("hold", catalog.recipe_path, given, options.overrides(None, scale=scale)).recipe
    recording = open_recording(source, found, catalog)
    try:
        shown = _opened(ply_sequence, renders, recording.info, first, found)
        frames = [t for t in shown.frames if t >= (low or 0) and (high is None or t < high)]
        measured.fits(recording.info, found.data.leak, frames)
        evaluation = evaluate_frames(shown, recording, frames=frames, lpips=lpips, progress=progress_on("frame"))
    finally:
        recording.close()
    counted = [shown.file(t) for t in frames] if files is None else [files]
    measured.show(evaluation, bytes_line([path for path in counted if path is not None], len(frames)))


def _opened(
    ply_sequence: Path | None, renders: Path | None, info: SourceInfo, first: int, recipe: Recipe
) -> PlySequence | Renders:
    from gsstream_lab.files import PlySequence, Renders

    if ply_sequence is None:
        assert renders is not None, "one of the two is given"
        return Renders(renders, info, first)
    # Gaussians of other programs are trained on black, unless their folder or a recipe says otherwise.
    behind = (0.0, 0.0, 0.0) if recipe.background == "auto" else recipe.background
    return PlySequence(ply_sequence, info, first, behind)
