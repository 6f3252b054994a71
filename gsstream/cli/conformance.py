"""``gsstream conformance``: a decoder of streams held against the suite of docs/spec."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gsstream.cli.listing import plural, printable, table
from gsstream.cli.streams import progress_on

if TYPE_CHECKING:
    from gsstream.packet.conformance import Result

#: Folder of the suite in a checkout; an installed gsstream has no suite.
SUITE = Path(__file__).parents[2] / "tests" / "conformance"


def conformance(
    program: Annotated[
        str | None,
        typer.Option(help="A decoder, with its own arguments: it is called with the path of a stream behind them."),
    ] = None,
    vectors: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of the suite; without it that of the checkout.")
    ] = None,
) -> None:
    """Play the streams of the conformance suite with a decoder, and compare the hash of every frame.

    Without a program the decoder is that of this package. The exit code is 1 where a stream is not played or not
    refused as it must be.
    """
    from gsstream.packet.conformance import by_feature, cite, judge, load_cases, play_here, play_with

    suite = vectors or SUITE
    cases = load_cases(suite)
    named = play_with(shlex.split(program)) if program is not None else lambda path: cite(suite, play_here(path))
    results: list[Result] = []
    advance = progress_on("stream")
    for case in cases:
        results.append(judge(case, named(case.path)))
        if advance is not None:
            advance(len(results), len(cases))
    for result in results:
        if result.problem is not None:
            typer.echo(f"{result.case.path}: {printable(result.problem)}")
    rows = [(name, *map(str, counts)) for name, *counts in by_feature(results)]
    typer.echo(table(("FEATURE", "STREAMS", "PASSED", "LEFT OUT", "FAILED"), rows))
    failed = sum(result.problem is not None for result in results)
    if failed:
        typer.echo(f"{plural(failed, 'stream')} of {len(results)} failed", err=True)
        raise typer.Exit(1)
