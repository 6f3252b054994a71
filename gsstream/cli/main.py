"""The command table. Nothing heavy is imported here: each command imports what it needs when it runs."""

from __future__ import annotations

import sys
import traceback
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import typer
from typer.main import get_command

from gsstream import API_VERSION, __version__
from gsstream.cli.listing import printable
from gsstream.cli.system_errors import describe, drop_output, flush_output
from gsstream.cli.table import CommandTable
from gsstream.core.errors import GsstreamError, InputError
from gsstream.core.install_hints import missing_for_encoding

#: Exit codes of runs that a service ended: 128 plus the number of the signal.
_SIGNALS = {129: "SIGHUP", 143: "SIGTERM"}
#: Messages may have several lines; other control characters are left out, because a terminal would obey them.
_LINE = "\n"


@dataclass
class GlobalOptions:
    """Values of the options before the command's name."""

    debug: bool = False


app = typer.Typer(
    name="gsstream",
    cls=CommandTable,
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 120},
    epilog="Begin with: gsstream run --source demo --out runs/demo, then: gsstream open runs/demo",
)


def _version(show: bool) -> None:
    if show:
        typer.echo(f"gsstream {__version__} (component API {API_VERSION})")
        raise typer.Exit


@app.callback()
def _root(
    context: typer.Context,
    debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False,
    _version_wanted: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Online free-viewpoint video as a stream of 3D Gaussians, built from swappable parts."""
    context.obj.debug = debug


def main(argv: Sequence[str] | None = None) -> None:
    """Run one command and exit.

    Exit codes: 0 done, 2 something given is wrong, 130 interrupted, 129 and 143 ended by a signal, 1 everything else.
    """
    sys.exit(run_command(sys.argv[1:] if argv is None else argv))


def run_command(argv: Sequence[str]) -> int:
    """Run one command; errors become one clear message on stderr and an exit code."""
    options = GlobalOptions()
    with warnings.catch_warnings():
        warnings.showwarning = _show_warning
        try:
            code = get_command(app).main(list(argv), prog_name="gsstream", standalone_mode=False, obj=options)
            flush_output()
        except typer.TyperException as error:
            error.show()  # type: ignore[attr-defined]  # every error of the parser has it; typer's base class hides it
            return error.exit_code
        except (typer.Abort, KeyboardInterrupt):
            return _interrupted()
        except GsstreamError as error:
            if options.debug:
                traceback.print_exc()
            else:
                typer.echo(f"error: {printable(error, keep=_LINE)}", err=True)
                for note in getattr(error, "__notes__", ()):
                    typer.echo(printable(note, keep=_LINE), err=True)
            return 2 if isinstance(error, InputError) else 1
        except ModuleNotFoundError as error:
            if options.debug or (cure := missing_for_encoding(error)) is None:
                raise
            typer.echo(f"error: {printable(cure)}", err=True)
            return 1
        except (OSError, MemoryError, RuntimeError) as error:
            if options.debug or (described := describe(error)) is None:
                raise
            drop_output()
            typer.echo(f"error: {printable(described[1])}", err=True)
            return described[0]
    if code == 130:
        return _interrupted()
    if code in _SIGNALS:
        typer.echo(f"ended by {_SIGNALS[code]}", err=True)
    return code if isinstance(code, int) else 0


def _interrupted() -> int:
    typer.echo("interrupted", err=True)
    return 130


def _show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    typer.echo(f"warning: {printable(message, keep=_LINE)}", err=True)
