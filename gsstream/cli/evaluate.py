"""``gsstream evaluate``: how good a stream is, or the files of a method that was trained elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gsstream.cli import options
from gsstream.cli.grouped import grouped
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
from gsstream.core.errors import InputError, PacketError

if TYPE_CHECKING:
    from gsstream.evaluation.evaluate import Evaluation
    from gsstream.input.recordings.base import SourceInfo
    from gsstream.metrics import OnnxLpips


@dataclass(frozen=True)
class Elsewhere:
    """What a method left that was trained elsewhere, in place of a stream."""

    ply_sequence: Annotated[
        Path | None, typer.Option("--ply-sequence", help="Folder of 3DGS PLYs, one per frame, in place of a stream.")
    ] = None
    renders: Annotated[
        Path | None, typer.Option("--renders", help="Folder of pictures, CAMERA/FRAME.png, in place of a stream.")
    ] = None
    files: Annotated[
        Path | None,
        typer.Option("--files", help="File or folder whose bytes count, with these; default: the PLYs themselves."),
    ] = None
    first: Annotated[
        int, typer.Option("--first", min=0, help="With these: the number in a file's name that means frame 0.")
    ] = 0
    recipe: Annotated[
        Path | None, typer.Option("--recipe", help="With these: YAML file with what the recording needs.")
    ] = None
    scale: options.Scale = None


@dataclass(frozen=True)
class LpipsOptions:
    """A network that measures LPIPS."""

    lpips_onnx: Annotated[
        Path | None,
        typer.Option("--lpips-onnx", help="LPIPS as an ONNX file (docs/howto/lpips.md); default: not measured."),
    ] = None
    lpips_range: Annotated[
        str | None,
        typer.Option(
            "--lpips-range", metavar="-1|0", help="Lower end of the range that file is given; default: its metadata."
        ),
    ] = None


@dataclass(frozen=True)
class Asked:
    """What is measured: frames from the first to before the last, LPIPS, and the protocol that it has to fit."""

    frames: tuple[int | None, int | None]
    lpips: OnnxLpips | None
    protocol: str | None

    def fits(self, info: SourceInfo, leak: str, frames: Sequence[int]) -> None:
        """Raise InputError where the protocol does not admit this recording, what its test cameras gave, or frames."""
        from gsstream.evaluation.protocol import check_protocol

        if self.protocol is not None:
            check_protocol(self.protocol, info, leak, frames)


@grouped
def evaluate(
    elsewhere: Elsewhere,
    network: LpipsOptions,
    stream: Annotated[Path | None, typer.Argument(help="A stream (.gss), or the output folder of a run.")] = None,
    source: Annotated[
        str | None, typer.Option("--source", help="Recording to compare with; default: the one it was made from.")
    ] = None,
    frames: Frames = None,
    protocol: Annotated[
        str | None,
        typer.Option(
            "--protocol",
            metavar="panoptic-sports|n3dv|meetroom",
            help="Refuse what a published protocol does not admit, and add the numbers that it reports.",
        ),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Every view of every frame as JSON, for scripts.")] = False,
    max_memory: MaxMemory = None,
) -> None:
    """Render the decoded frames and compare them with the test cameras.

    Also what a method left that was trained elsewhere: --ply-sequence or --renders with --source.
    """
    from gsstream.evaluation.protocol import find_protocol, protocol_line, protocol_numbers

    _check(stream, source, elsewhere)
    if protocol is not None:
        find_protocol(protocol)
    lpips = _lpips(network.lpips_onnx, network.lpips_range)
    asked, damage, said = Asked(frame_range(frames), lpips, protocol), None, ""
    if stream is not None:
        evaluation, damage = _of_stream(stream, source, asked, size_of(max_memory))
    else:
        assert source is not None, "checked above"
        evaluation, said = _of_files(elsewhere, source, asked)
    numbers = None if protocol is None else protocol_numbers(protocol, evaluation)
    if as_json:
        typer.echo(evaluation.to_json(numbers))
    else:
        lines = evaluation.table(), said, "" if numbers is None else protocol_line(numbers)
        typer.echo("\n\n".join(filter(None, lines)))
    fail_with(damage)


def _check(stream: Path | None, source: str | None, other: Elsewhere) -> None:
    """Refuse options that would do nothing. Raises InputError."""
    if sum(given is not None for given in (stream, other.ply_sequence, other.renders)) != 1:
        raise InputError("expected one of STREAM, --ply-sequence DIR and --renders DIR, to say what is evaluated")
    if stream is None and source is None:
        raise InputError("--ply-sequence and --renders do not say which recording they show; name it with --source")
    if stream is not None and any((other.files, other.recipe, other.scale, other.first)):
        raise InputError("--files, --first, --recipe and --scale belong to --ply-sequence and --renders")


def _lpips(file: Path | None, lower: str | None) -> OnnxLpips | None:
    from gsstream.metrics import OnnxLpips

    if lower is not None and file is None:
        raise InputError(f"--lpips-range {lower}: without --lpips-onnx there is no LPIPS to give it to")
    return None if file is None else OnnxLpips(file, lower)


def _of_stream(
    stream: Path, source: str | None, asked: Asked, most: int | None
) -> tuple[Evaluation, PacketError | None]:
    from gsstream.discovery.catalog import load_catalog
    from gsstream.engine.run.recording import reopen_recording
    from gsstream.evaluation.evaluate import evaluate as evaluate_stream
    from gsstream.player.playback import Playback

    file = stream_file(stream)
    with Playback(file, max_memory=most) as playback:
        meta = playback.meta
        frames, damage = playback.sound(*asked.frames)
        if playback.limit is not None:
            playback.limit.check_pictures(meta.test.width, meta.test.height, len(meta.test))
            for frame in frames:
                playback.state_at(frame)
    catalog = load_catalog()
    uri = source or named_recording(file, meta, catalog)
    check_recipe(file, meta.recipe)
    recording = reopen_recording(uri, meta.recipe, catalog)
    try:
        # Another writer may leave the recipe empty.
        asked.fits(recording.info, meta.recipe.get("data", {}).get("leak", "none"), frames)
        return evaluate_stream(file, recording, frames=frames, lpips=asked.lpips, progress=progress_on("frame")), damage
    finally:
        recording.close()


def _of_files(other: Elsewhere, source: str, asked: Asked) -> tuple[Evaluation, str]:
    """The evaluation of a folder, and a line that says what its files take."""
    from gsstream.discovery.catalog import load_catalog
    from gsstream.engine.run.recording import open_recording
    from gsstream.evaluation.evaluate import evaluate_frames
    from gsstream.evaluation.offline import PlySequence, Renders, bytes_line
    from gsstream.recipe.load import resolve_recipe

    catalog = load_catalog()
    files = [] if other.recipe is None else [other.recipe]
    found = resolve_recipe("hold", catalog.recipe_path, files, options.overrides(None, scale=other.scale)).recipe
    recording = open_recording(source, found, catalog)
    try:
        if other.ply_sequence is not None:
            # What the files of others were trained on is black, unless they or a recipe say otherwise.
            behind = (0.0, 0.0, 0.0) if found.background == "auto" else found.background
            shown: PlySequence | Renders = PlySequence(other.ply_sequence, recording.info, other.first, behind)
        else:
            assert other.renders is not None, "checked above"
            shown = Renders(other.renders, recording.info, other.first)
        low, high = asked.frames
        frames = [t for t in shown.frames if t >= (low or 0) and (high is None or t < high)]
        asked.fits(recording.info, found.data.leak, frames)
        evaluation = evaluate_frames(shown, recording, frames=frames, lpips=asked.lpips, progress=progress_on("frame"))
    finally:
        recording.close()
    plys = [shown.file(t) for t in frames] if other.ply_sequence is not None else []
    counted = plys if other.files is None else [other.files]
    return evaluation, bytes_line([path for path in counted if path is not None], len(frames))
