"""``gsstream evaluate``: how good a stream is, or the files of a method that was trained elsewhere."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gsstream.cli import options
from gsstream.cli.streams import (
    Frames,
    MaxMemory,
    check_recipe,
    fail_with,
    frame_range,
    named_recording,
    progress_on,
    size_of,
    stream_file,
)

if TYPE_CHECKING:
    from gsstream.core.errors import PacketError
    from gsstream.metrics import OnnxLpips
    from gsstream.trade.measure.evaluate import Evaluation


def evaluate(
    stream: Annotated[Path | None, typer.Argument(help="A stream (.gss), or the output folder of a run.")] = None,
    source: Annotated[
        str | None, typer.Option("--source", help="Recording to compare with; default: the one it was made from.")
    ] = None,
    ply_sequence: Annotated[
        Path | None, typer.Option("--ply-sequence", help="Folder of 3DGS PLYs, one per frame, in place of a stream.")
    ] = None,
    renders: Annotated[
        Path | None, typer.Option("--renders", help="Folder of pictures, CAMERA/FRAME.png, in place of a stream.")
    ] = None,
    files: Annotated[
        Path | None,
        typer.Option("--files", help="File or folder whose bytes count, with these; default: the PLYs themselves."),
    ] = None,
    first: Annotated[
        int, typer.Option("--first", min=0, help="With these: the number in a file's name that means frame 0.")
    ] = 0,
    frames: Frames = None,
    recipe: Annotated[
        Path | None, typer.Option("--recipe", help="With these: YAML file with what the recording needs.")
    ] = None,
    scale: options.Scale = None,
    lpips_onnx: Annotated[
        Path | None,
        typer.Option("--lpips-onnx", help="LPIPS as an ONNX file (docs/howto/lpips.md); default: not measured."),
    ] = None,
    lpips_range: Annotated[
        str | None,
        typer.Option(
            "--lpips-range", metavar="-1|0", help="Lower end of the range that file is given; default: its metadata."
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Every view of every frame as JSON, for scripts.")] = False,
    max_memory: MaxMemory = None,
) -> None:
    """Render the decoded frames and compare them with the recording's test cameras.

    Also what a method left that was trained elsewhere: --ply-sequence or --renders with --source.
    """
    _check(stream, ply_sequence, renders, source, files, recipe, scale, first)
    lpips = _lpips(lpips_onnx, lpips_range)
    chosen, damage = frame_range(frames), None
    if stream is not None:
        evaluation, damage = _of_stream(stream, source, chosen, lpips, size_of(max_memory))
        said = ""
    else:
        folder = ply_sequence or renders
        assert folder is not None, "checked above"
        assert source is not None, "checked above"
        kind = "plys" if ply_sequence else "renders"
        evaluation, said = _of_files(folder, kind, source, files, first, chosen, recipe, scale, lpips)
    typer.echo(evaluation.to_json() if as_json else "\n\n".join(filter(None, (evaluation.table(), said))))
    fail_with(damage)


def _check(
    stream: Path | None, plys: Path | None, renders: Path | None, source: str | None, files: Path | None,
    recipe: Path | None, scale: float | None, first: int,
) -> None:  # fmt: skip
    """Refuse options that would do nothing. Raises InputError."""
    from gsstream.core.errors import InputError

    if sum(given is not None for given in (stream, plys, renders)) != 1:
        raise InputError("expected one of STREAM, --ply-sequence DIR and --renders DIR, to say what is evaluated")
    if stream is None and source is None:
        raise InputError("--ply-sequence and --renders do not say which recording they show; name it with --source")
    if stream is not None and any((files, recipe, scale, first)):
        raise InputError("--files, --first, --recipe and --scale belong to --ply-sequence and --renders")


def _lpips(file: Path | None, lower: str | None) -> OnnxLpips | None:
    from gsstream.core.errors import InputError
    from gsstream.metrics import OnnxLpips

    if lower is not None and file is None:
        raise InputError(f"--lpips-range {lower}: without --lpips-onnx there is no LPIPS to give it to")
    return None if file is None else OnnxLpips(file, lower)


def _of_stream(
    stream: Path, source: str | None, chosen: tuple[int | None, int | None], lpips: OnnxLpips | None, most: int | None
) -> tuple[Evaluation, PacketError | None]:
    from gsstream.engine.run.recording import reopen_recording
    from gsstream.player.playback import Playback
    from gsstream.plugins.catalog import load_catalog
    from gsstream.trade.measure.evaluate import evaluate as evaluate_stream

    file = stream_file(stream)
    with Playback(file, max_memory=most) as playback:
        meta = playback.meta
        frames, damage = playback.sound(*chosen)
        if playback.limit is not None:
            playback.limit.check_pictures(meta.test.width, meta.test.height, len(meta.test))
            for frame in frames:
                playback.state_at(frame)
    catalog = load_catalog()
    uri = source or named_recording(file, meta, catalog)
    check_recipe(file, meta.recipe)
    recording = reopen_recording(uri, meta.recipe, catalog)
    try:
        return evaluate_stream(file, recording, frames=frames, lpips=lpips, progress=progress_on("frame")), damage
    finally:
        recording.close()


def _of_files(
    folder: Path, kind: str, source: str, files: Path | None, first: int, chosen: tuple[int | None, int | None],
    recipe: Path | None, scale: float | None, lpips: OnnxLpips | None,
) -> tuple[Evaluation, str]:  # fmt: skip
    """The evaluation of a folder, and a line that says what its files take."""
    from gsstream.engine.run.recording import open_recording
    from gsstream.plugins.catalog import load_catalog
    from gsstream.recipe.load import resolve_recipe
    from gsstream.trade.measure.evaluate import evaluate_shown
    from gsstream.trade.measure.offline import PlySequence, Renders, bytes_line

    catalog = load_catalog()
    overrides = options.overrides(None, scale=scale)
    found = resolve_recipe("hold", catalog.recipe_path, [] if recipe is None else [recipe], overrides).recipe
    recording = open_recording(source, found, catalog)
    try:
        if kind == "plys":
            shown: PlySequence | Renders = PlySequence(folder, recording.info, first, found.background)
        else:
            shown = Renders(folder, recording.info, first)
        low, high = chosen
        frames = [t for t in shown.frames if t >= (low or 0) and (high is None or t < high)]
        evaluation = evaluate_shown(shown, recording, frames=frames, lpips=lpips, progress=progress_on("frame"))
    finally:
        recording.close()
    counted = [files] if files is not None else [shown.file(t) for t in frames] if kind == "plys" else []
    return evaluation, bytes_line([path for path in counted if path is not None], len(frames))
