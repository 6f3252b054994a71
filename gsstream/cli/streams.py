"""``gsstream play`` and ``evaluate``: pictures of a stream and how good they are."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gsstream.cli.listing import plural
from gsstream.core.errors import InputError, PacketError
from gsstream.core.names import child

if TYPE_CHECKING:
    from gsstream.discovery.catalog import Catalog
    from gsstream.packet import StreamMeta
    from gsstream.player.playback import Playback

Stream = Annotated[Path, typer.Argument(help="A stream (.gss), or the output folder of a run.")]
Frames = Annotated[
    str | None, typer.Option("--frames", metavar="A:B", help="Frames A to B - 1; either may be left out.")
]

MaxMemory = Annotated[
    str | None,
    typer.Option(
        "--max-memory", metavar="SIZE", help="Refuse what would take more, e.g. 500MB; default: half of the memory."
    ),
]


def play(
    stream: Stream,
    out: Annotated[Path, typer.Option("--out", help="Folder for pictures, or a file: .mp4, .webp or .gif.")],
    camera: Annotated[
        str | None,
        typer.Option(
            "--camera",
            help="Camera id, orbit, spiral, train, test, all, or FILE.json with a path; default: first test camera.",
        ),
    ] = None,
    frames: Frames = None,
    fps: Annotated[
        float | None,
        typer.Option("--fps", help="Pictures per second, moments between frames included; default: the recording's."),
    ] = None,
    size: Annotated[
        str | None, typer.Option("--size", metavar="WxH", help="Pixels of the pictures; default: those of the camera.")
    ] = None,
    renderer: Annotated[
        str | None,
        typer.Option("--renderer", help="numpy, or one that a plugin offers; default: the first of those that works."),
    ] = None,
    max_memory: MaxMemory = None,
) -> None:
    """Decode a stream and render it, without torch or the recording."""
    first, last = frame_range(frames)
    most, pixels = size_of(max_memory), picture_size(size)
    file = stream_file(stream)
    from gsstream.player.play import check_target
    from gsstream.player.play import play as play_stream
    from gsstream.player.playback import Playback
    from gsstream.player.render import named_renderer

    chosen_renderer = None if renderer is None else named_renderer(renderer)
    check_target(out)

    with Playback(file, max_memory=most) as playback:
        cameras = _cameras(playback, camera)
        chosen, damage = playback.sound(first, last)
    for name in cameras:
        target = out if len(cameras) == 1 else _one_of_many(out, name or "")
        played = play_stream(
            file,
            target,
            camera=name,
            frames=chosen,
            progress=progress_on(name or "camera"),
            max_memory=most,
            size=pixels,
            renderer=chosen_renderer,
            fps=fps,
        )
        typer.echo(f"{played.path}: {plural(played.frames, 'picture')}")
    fail_with(damage)


def stream_file(path: Path) -> Path:
    """Return the stream file meant by ``path``. Raises InputError that names the path when there is none."""
    file = path / "stream.gss" if path.is_dir() else path
    if not file.is_file():
        raise InputError(f"no stream at {file}: expected a .gss file or the output folder of a run")
    return file


def _one_of_many(out: Path, camera: str) -> Path:
    """Several cameras make one file or folder each, named after the camera."""
    return child(out.parent, f"{out.stem}-{camera}{out.suffix}") if out.suffix else child(out, camera)


def _cameras(playback: Playback, wanted: str | None) -> list[str | None]:
    """Ids meant by --camera; None is the player's own choice."""
    train, test = list(playback.meta.train.ids), list(playback.meta.test.ids)
    groups: dict[str | None, list[str]] = {"train": train, "test": test, "all": train + test}
    found = groups.get(wanted)
    if found is None:
        return [wanted]
    if not found:
        raise InputError(f"--camera {wanted}: this stream has no {wanted} cameras")
    return list(found)


def named_recording(file: Path, meta: StreamMeta, catalog: Catalog) -> str:
    """Return the recording that a stream was made from, if a file from a stranger may choose this recording.

    A stream says which recording that was and, but for the demo and synthetic scenes, not where it lies: this stands in
    recording.txt of the run's folder. What waits (watch:), is fetched from an address or is opened by a plugin is only
    opened when the user names it. Raises InputError.
    """
    from gsstream.input.recordings.origin import RECORDING, public_uri, read_recording
    from gsstream.store.address import SCHEMES

    said = str(meta.extra.get("source_uri", ""))
    if said == "demo" or said.startswith("synthetic:"):
        return said
    if said.startswith("rig:"):
        raise InputError(f"{file} was made from images that Python gave; name a recording of them with --source")
    beside = read_recording(file)
    if beside is None:
        raise InputError(
            f"{file} was made from the recording {said[:200]!r} and does not say where that lies, which only "
            f"{RECORDING} in the folder of a run does; name it with --source"
        )
    for scheme in beside.split(":")[:-1]:
        entry = catalog.entries.get(("source", scheme))
        if scheme in ("watch", *SCHEMES) or (entry is not None and entry.plugin != "builtin"):
            raise InputError(
                f"{file} was made from {beside[:200]!r}, by {RECORDING} beside it, which is not opened because a file "
                "says so; if you trust it, name it yourself with --source"
            )
    if public_uri(beside) != said:
        raise InputError(
            f"{file} was made from the recording {said[:200]!r}, but {RECORDING} beside it names {beside[:200]!r}; "
            "name the right one with --source"
        )
    return beside


def check_recipe(file: Path, recipe: Mapping[str, Any]) -> None:
    """Refuse a recipe in a stream whose scale or seed no run can have had. Raises InputError."""
    scale, seed = recipe.get("scale", 1.0), recipe.get("seed", 0)
    if isinstance(scale, bool) or not isinstance(scale, int | float) or not 0 < scale <= 1:
        raise InputError(f"{file}: its recipe says scale = {str(scale)[:40]!r}; expected a factor in (0, 1]")
    if type(seed) is not int:
        raise InputError(f"{file}: its recipe says seed = {str(seed)[:40]!r}; expected a whole number")


def fail_with(damage: PacketError | None) -> None:
    """Raise the error that ends a damaged stream, after its sound frames are done: exit code 1, byte of the damage."""
    if damage is not None:
        raise damage


def frame_range(text: str | None) -> tuple[int | None, int | None]:
    """Return A and B of "A:B"; None where one is left out."""
    match = re.fullmatch(r"(\d*):(\d*)", ":" if text is None else text)
    first, last = (int(number) if number else None for number in match.groups()) if match else (0, 0)
    if last is not None and last <= (first or 0):
        raise InputError(f"--frames {text}: expected A:B with A < B, e.g. 0:30, or A: for all frames from A on")
    return first, last


def picture_size(text: str | None) -> tuple[int, int] | None:
    """Return (width, height) meant by ``--size``; None: that of the camera. Raises InputError."""
    if text is None:
        return None
    match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text)
    width, height = (int(side) for side in match.groups()) if match else (0, 0)
    if not (0 < width <= 1 << 16 and 0 < height <= 1 << 16):
        raise InputError(f"--size {text}: expected WIDTHxHEIGHT in pixels, each 1 to 65536, e.g. 1280x720")
    return width, height


def size_of(text: str | None) -> int | None:
    """Return the bytes meant by ``--max-memory``; None: no limit."""
    from gsstream.core.quantity import BYTES, read_quantity

    if text is None:
        return None
    try:
        size = read_quantity(text, BYTES)
    except ValueError as error:
        raise InputError(f"--max-memory {text}: {error}") from error
    if size < 1:
        raise InputError(f"--max-memory {text}: expected a positive size, e.g. 500MB")
    return int(size)


def progress_on(what: str) -> Callable[[int, int], None] | None:
    """Return a counter that overwrites itself on a terminal and is silent elsewhere."""
    if not sys.stderr.isatty():
        return None

    def show(done: int, total: int) -> None:
        typer.echo(f"\r{what} {done}/{total}", nl=done == total, err=True)

    return show
