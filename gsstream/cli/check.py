"""``gsstream check``: the contract kit, for a person."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated

import typer

from gsstream.core.errors import InputError

if TYPE_CHECKING:
    from gsstream.plugins.catalog import Catalog
    from gsstream.testing.kit import CheckResult

MARKS = {"passed": "✓", "failed": "✗", "expected failure": "⚠", "skipped": "⚠"}


def check(
    name: Annotated[str, typer.Argument(help="A part (NAME or KIND/NAME), a plugin, a method, or 'packets'.")],
    source: Annotated[
        str | None, typer.Option("--source", help="Recording on which a source is checked; by default 'NAME:'.")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print only what did not pass, and the counts.")] = False,
) -> None:
    """Check that a part, everything in a plugin, or a method keeps the contract; exit code 1 when it does not."""
    from gsstream.plugins.catalog import load_catalog
    from gsstream.testing.kit import summary

    everything: list[CheckResult] = []
    for heading, results in _subjects(load_catalog(), name, source):
        typer.echo(heading)
        for result in results:
            if not (quiet and result.status == "passed"):
                typer.echo(_line(result))
        everything += results
        typer.echo(f"  {summary(results)}")
    if not all(result.ok for result in everything) or all(result.status == "skipped" for result in everything):
        raise typer.Exit(1)


def _line(result: CheckResult) -> str:
    text = f"  {MARKS[result.status]} {result.check.removeprefix('check_')}"
    if result.status == "passed":
        return text
    indented = result.message.replace("\n", "\n      ")
    return f"{text}: {indented}" if result.status == "failed" else f"{text} ({result.status}): {indented}"


def _subjects(catalog: Catalog, name: str, source: str | None) -> Iterator[tuple[str, list[CheckResult]]]:
    """(heading, results) of everything meant by a name: first of all names, so that a wrong one is answered at once."""
    wanted = _entries(catalog, name)
    if source is not None and not any(kind == "source" for kind, _ in wanted):
        raise InputError(f"--source is the recording on which a source is checked; {name!r} holds no source")
    # The slow imports come last, so that a mistake on the command line is answered at once.
    from gsstream.testing.kit import run_checks, run_method_checks, run_packet_checks
    from gsstream.testing.recording import SourceUnderTest

    if name == "packets":
        yield "packet format", run_packet_checks()
    for kind, part in wanted:
        heading = f"{kind} {part} (from {catalog.entry(kind, part).origin})"
        if kind == "method":
            yield heading, run_method_checks(part)
        elif kind == "source":
            # The demo is no folder and needs no place; any other source is asked for its simplest recording.
            guess = part if part == "demo" else f"{part}:"
            yield heading, run_checks(SourceUnderTest(catalog.resolve(kind, part), source or guess, given=bool(source)))
        else:
            yield heading, run_checks(catalog.resolve(kind, part)())


def _entries(catalog: Catalog, name: str) -> list[tuple[str, str]]:
    """Parts and methods of this name, or of the plugin or distribution of this name.

    Raises PluginUnavailable when it is in quarantine, UnknownName when nothing is called so.
    """
    from gsstream.core.errors import UnknownName
    from gsstream.spec import KINDS

    kind, _, part = name.rpartition("/")
    if kind and kind not in KINDS:
        raise UnknownName("kind of part", kind, KINDS)
    found = []
    for key, entry in catalog.entries.items():
        named = key[1] == part and kind in ("", key[0])
        shipped = not kind and name in (entry.plugin, entry.distribution)
        if (named or shipped) and key[0] in KINDS:
            found.append(key)
    if found or name == "packets":
        return found
    for plugin in catalog.quarantine:
        if part in (plugin.name, plugin.distribution) or any(spec.name == part for spec in plugin.declared):
            raise plugin.unavailable(name) from plugin.error
    known = {key[1] for key in catalog.entries if kind in ("", key[0])} | {p.name for p in catalog.plugins}
    raise UnknownName("part, plugin or method", name, known)
