"""``gsstream evaluate``: how good a stream is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

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
from gsstream.core.errors import InputError
from gsstream.core.memory import limited_memory

if TYPE_CHECKING:
    from gsstream.evaluation.evaluate import Evaluation
    from gsstream.input.recordings.base import SourceInfo
    from gsstream.metrics import OnnxLpips


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

    def load(self) -> OnnxLpips | None:
        """Return the network; None without a file. Raises InputError for a range without a file."""
        from gsstream.metrics import OnnxLpips

        if self.lpips_range is not None and self.lpips_onnx is None:
            raise InputError(f"--lpips-range {self.lpips_range}: without --lpips-onnx there is no LPIPS to give it to")
        return None if self.lpips_onnx is None else OnnxLpips(self.lpips_onnx, self.lpips_range)


@dataclass(frozen=True)
class MeasureOptions:
    """What is measured, and how it is printed."""

    frames: Frames = None
    protocol: Annotated[
        str | None,
        typer.Option(
            "--protocol",
            metavar="panoptic-sports|n3dv|meetroom",
            help="Refuse what a published protocol does not admit, and add the numbers that it reports.",
        ),
    ] = None
    as_json: Annotated[bool, typer.Option("--json", help="Every view of every frame as JSON, for scripts.")] = False

    def __post_init__(self) -> None:
        """Raise UnknownName for a protocol that is none, before anything is opened."""
        if self.protocol is not None:
            from gsstream.evaluation.protocol import find_protocol

            find_protocol(self.protocol)

    def fits(self, info: SourceInfo, leak: str, frames: Sequence[int]) -> None:
        """Raise InputError where the protocol does not admit this recording, what its test cameras gave, or frames."""
        from gsstream.evaluation.protocol import check_protocol

        if self.protocol is not None:
            check_protocol(self.protocol, info, leak, frames)

    def show(self, evaluation: Evaluation, said: str = "") -> None:
        """Print an evaluation, a line about it, and what the protocol reports."""
        from gsstream.evaluation.protocol import protocol_line, protocol_numbers

        numbers = None if self.protocol is None else protocol_numbers(self.protocol, evaluation)
        if self.as_json:
            typer.echo(evaluation.to_json(numbers))
        else:
            lines = evaluation.table(), said, "" if numbers is None else protocol_line(numbers)
            typer.echo("\n\n".join(filter(None, lines)))


@grouped
def evaluate(
    network: LpipsOptions,
    measured: MeasureOptions,
    stream: Annotated[Path, typer.Argument(help="A stream (.gss), or the output folder of a run.")],
    source: Annotated[
        str | None, typer.Option("--source", help="Recording to compare with; default: the one it was made from.")
    ] = None,
    max_memory: MaxMemory = None,
) -> None:
    """Render the decoded frames and compare them with the test cameras.

    Files of a method that was trained elsewhere: gsstream evaluate-files, of gsstream-lab.
    """
    from gsstream.discovery.catalog import load_catalog
    from gsstream.engine.run.recording import reopen_recording
    from gsstream.evaluation.evaluate import evaluate as evaluate_stream
    from gsstream.player.playback import Playback

    lpips = network.load()
    file = stream_file(stream)
    with Playback(file, max_memory=size_of(max_memory)) as playback:
        meta = playback.meta
        frames, damage = playback.sound(*frame_range(measured.frames))
        playback.limit.check_pictures(meta.test.width, meta.test.height, len(meta.test))
        if max_memory is not None:
            for frame in frames:
                playback.state_at(frame)
    catalog = load_catalog()
    uri = source or named_recording(file, meta, catalog)
    check_recipe(file, meta.recipe)
    recording = reopen_recording(uri, meta.recipe, catalog)
    try:
        # Another writer may leave the recipe empty.
        measured.fits(recording.info, meta.recipe.get("data", {}).get("leak", "none"), frames)
        with limited_memory(size_of(max_memory)):
            evaluation = evaluate_stream(file, recording, frames=frames, lpips=lpips, progress=progress_on("frame"))
    finally:
        recording.close()
    measured.show(evaluation)
    fail_with(damage)
