"""``gsstream calibrate``: lenses and poses of a rig of one's own."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(add_completion=False, rich_markup_mode=None, no_args_is_help=True)


@app.callback()
def calibrate() -> None:
    """Find lenses and poses of a rig by pictures of a printed board, or of whatever the rig sees."""


@app.command("print")
def print_board(
    out: Annotated[Path, typer.Option("--out", help="New folder for board.pdf and board.yaml.")],
    square: Annotated[float, typer.Option("--square", min=5, max=500, help="Side of a square, mm; 56 fits A3.")] = 56.0,
    dictionary: Annotated[
        str, typer.Option("--dictionary", help="Markers by OpenCV's name, DICT_APRILTAG_36h11 among them.")
    ] = "DICT_5X5_100",
) -> None:
    """Write a board to print, with a ruler to measure the print by."""
    from gsstream_capture.board.design import Board, page, read_board
    from gsstream_capture.board.takes import BOARD_FILE

    board = Board(square_mm=square, dictionary=dictionary)
    out.mkdir(parents=True, exist_ok=True)
    lines = [f"{key}: {value}" for key, value in board.model_dump().items() if not isinstance(value, bool)]
    (out / BOARD_FILE).write_text("\n".join(lines) + "\n", encoding="utf-8")
    page(read_board(out / BOARD_FILE)).save(out / "board.pdf", resolution=254.0)
    typer.echo(f"wrote {out / 'board.pdf'} and {out / BOARD_FILE}")


@app.command("board")
def board(
    takes: Annotated[Path, typer.Argument(metavar="TAKES", help="Folder with board.yaml, lens/ and rig/.")],
    out: Annotated[Path, typer.Option("--out", help="The cameras.json to write; the report goes beside it.")],
    fps: Annotated[float, typer.Option("--fps", min=0.1, max=1000, help="Rate of the recordings to come.")] = 10.0,
    quiet: Annotated[bool, typer.Option("--quiet", help="Show no progress.")] = False,
) -> None:
    """Find lenses and poses in metres from takes of a board.

    Refuses lenses that are not sure to one percent, and cameras that saw the board together with others too rarely.
    """
    from gsstream.cli.working import working
    from gsstream_capture.board.solve import report, solve, write
    from gsstream_capture.board.takes import read_takes

    _named(out)
    with working("looking for the board", quiet) as display:
        found = read_takes(takes, display.tell)
        display.tell("adjusting")
        solved = solve(found)
    write(solved, out, fps)
    text = report(solved)
    out.with_name("calibration.txt").write_text(text + "\n", encoding="utf-8")
    typer.echo(text)
    typer.echo(f"wrote {out}")


@app.command("scene")
def scene(
    raw: Annotated[Path, typer.Argument(metavar="RAW", help="Folder of 'gsstream capture --raw'.")],
    out: Annotated[Path, typer.Option("--out", help="The cameras.json to write.")],
    each: Annotated[bool, typer.Option("--each", help="Every camera has a lens of its own.")] = False,
    fps: Annotated[float, typer.Option("--fps", min=0.1, max=1000, help="Rate of the recordings to come.")] = 10.0,
) -> None:
    """Find lenses and poses by what the cameras see of one instant, without a board and without metres.

    It takes views that overlap and show texture; lenses are less sure than with a board.
    """
    from gsstream_capture.scene import calibrate_scene

    _named(out)
    calibrate_scene(raw, out, each=each, fps=fps, say=typer.echo)
    typer.echo(f"wrote {out}")


def _named(out: Path) -> None:
    from gsstream.core.errors import InputError
    from gsstream.input.recordings.calibration import CALIBRATION_FILE

    if out.name != CALIBRATION_FILE:
        raise InputError(f"--out {out}: expected a file of the name {CALIBRATION_FILE}")
