"""``gsstream check``: the contract kit, for a person."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gsstream.core.errors import STRANGERS, InputError, PluginUnavailable, UnknownName
from gsstream.core.kinds import FITTING_SLOTS

if TYPE_CHECKING:
    from gsstream.discovery.catalog import Catalog
    from gsstream.testing.kit import CheckResult

MARKS = {"passed": "✓", "failed": "✗", "warning": "⚠", "expected failure": "⚠", "skipped": "⚠"}


@dataclass(frozen=True)
class Subject:
    """One thing that was checked."""

    heading: str
    results: list[CheckResult]
    absent: bool = False  # the part cannot be made on this machine, so that nothing could be checked
    effect: str = ""  # what it does to a tiny recording


def check(
    name: Annotated[str, typer.Argument(help="A part (NAME or KIND/NAME), plugin, method or command, or 'packets'.")],
    source: Annotated[
        str | None, typer.Option("--source", help="Recording on which a source is checked; by default 'NAME:'.")
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Setting of the part, e.g. temperature=0.3; repeatable."),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print only what did not pass, and the counts.")] = False,
) -> None:
    """Check that a part, a method, or everything in a plugin keeps its contract.

    Exit code 1 when it does not.
    """
    from gsstream.discovery.catalog import load_catalog
    from gsstream.testing.kit import summary

    subjects = []
    for subject in _subjects(load_catalog(), name, source, settings or []):
        typer.echo(subject.heading)
        for line in _lines(subject, quiet):
            typer.echo(line)
        if subject.effect and not quiet:
            typer.echo(f"  {subject.effect}")
        typer.echo(f"  {summary(subject.results)}")
        subjects.append(subject)
    everything = [result for subject in subjects for result in subject.results]
    # It is a failure when nothing was checked, unless this machine lacks something that the part needs.
    idle = all(result.status == "skipped" for result in everything) and not all(subject.absent for subject in subjects)
    if idle or not all(result.ok for result in everything):
        raise typer.Exit(1)


def _lines(subject: Subject, quiet: bool) -> Iterator[str]:
    """Yield a line per check; checks of one reason share a line; ``quiet`` leaves out passed and unclaimed checks."""
    if subject.absent:
        yield _line(subject.results[0], "every check")
        return
    reasons = set()
    for result in subject.results:
        reason = (result.status, result.message)
        if reason in reasons or (quiet and result.status in ("passed", "skipped")):
            continue
        same = [each for each in subject.results if (each.status, each.message) == reason]
        if result.status == "failed" and len(same) > 1:
            reasons.add(reason)
            names = [each.check.removeprefix("check_") for each in same]
            yield _line(result, f"{len(same)} checks ({', '.join(names)})")
        else:
            yield _line(result, result.check)


def _line(result: CheckResult, what: str) -> str:
    text = f"  {MARKS[result.status]} {what.removeprefix('check_')}"
    if result.status == "passed":
        return text
    indented = result.message.replace("\n", "\n      ")
    return f"{text}: {indented}" if result.status == "failed" else f"{text} ({result.status}): {indented}"


def _subjects(catalog: Catalog, name: str, source: str | None, settings: list[str]) -> Iterator[Subject]:
    """Everything meant by a name, checked: first of all names, so that a wrong one is answered at once."""
    wanted = _entries(catalog, name)
    if source is not None and not any(kind == "source" for kind, _ in wanted):
        raise InputError(f"--source is the recording on which a source is checked; {name!r} holds no source")
    configured = None
    if settings:
        if len(wanted) != 1 or wanted[0][0] in ("source", "method", "command"):
            found = ", ".join(f"{kind}/{part}" for kind, part in wanted) or name
            raise InputError(f"--set gives settings to one part, KIND/NAME; {name!r} means {found}")
        configured = _config(catalog.resolve(*wanted[0]), settings)
    # The slow imports come last, so that a mistake on the command line is answered at once.
    from gsstream.spec import CommandSpec
    from gsstream.testing.kit import (
        run_checks,
        run_command_checks,
        run_method_checks,
        run_packet_checks,
    )
    from gsstream.testing.registry import SourceUnderTest

    if name == "packets":
        yield Subject("packet format", run_packet_checks())
    for kind, part in wanted:
        heading = f"{kind} {part} (from {catalog.entry(kind, part).origin})"
        if kind == "method":
            yield Subject(heading, run_method_checks(part))
        elif kind == "command":
            entry = catalog.entry(kind, part)
            assert isinstance(entry.spec, CommandSpec), "commands have this declaration"
            yield Subject(heading, run_command_checks(entry.spec, entry.origin))
        elif kind == "source":
            # The demo is no folder and needs no place; any other source is asked for its simplest recording.
            guess = part if part == "demo" else f"{part}:"
            recording = SourceUnderTest(catalog.resolve(kind, part), source or guess, given=bool(source))
            yield Subject(heading, run_checks(recording))
        else:
            yield _part_subject(kind, part, heading, catalog.resolve(kind, part), configured)


def _part_subject(kind: str, part: str, heading: str, cls: type[Any], configured: Any) -> Subject:
    """A part, built and checked; one that cannot be built because something is not installed is absent."""
    from gsstream.testing.kit import CheckResult, run_checks, skip_checks
    from gsstream.testing.method_driver import effect

    try:
        built = cls(configured or cls.Config())
    except PluginUnavailable as error:
        return Subject(heading, skip_checks(kind, part, str(error)), absent=True)
    except STRANGERS as error:
        problem = f"with {'these' if configured else 'its default'} settings: {type(error).__name__}: {error}"
        return Subject(heading, [CheckResult("construction", part, "failed", problem)])
    results = run_checks(built)
    sound = kind in FITTING_SLOTS and all(result.ok for result in results)
    return Subject(heading, results, effect=effect(kind, built) if sound else "")


def _config(cls: type[Any], settings: list[str]) -> Any:
    """The part's settings with these KEY=VALUE changed. Raises RecipeError for keys and values that it refuses."""
    from gsstream.engine.assembly.assemble import with_values
    from gsstream.recipe.check import join_problems, validate
    from gsstream.recipe.document import Origin, read_override

    values: dict[str, Any] = {}
    for text in settings:
        path, leaf = read_override(text)
        values = with_values(values, {".".join(path): leaf.value})
    problems: list[str] = []
    config = validate(cls.Config, values, lambda _: Origin("command line", "--set"), prefix=(), problems=problems)
    join_problems(problems, f"the settings of {cls.__name__}")
    return config


def _entries(catalog: Catalog, name: str) -> list[tuple[str, str]]:
    """Parts and methods of this name, or of the plugin or distribution of this name.

    Raises PluginUnavailable when it is in quarantine, UnknownName when nothing is called so.
    """
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
