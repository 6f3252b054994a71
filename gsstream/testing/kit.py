"""The contract kit: checks of the promises of every part, by pytest, by code, or by ``gsstream check NAME``."""

from __future__ import annotations

import functools
import importlib
import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

import torch

from gsstream.core.errors import STRANGERS
from gsstream.core.kinds import PART_KINDS
from gsstream.core.part import Part
from gsstream.discovery.catalog import Catalog, Entry
from gsstream.discovery.commands import command_of
from gsstream.engine.assembly.part_in_use import line_of
from gsstream.method.base import StreamingMethod
from gsstream.spec import CommandSpec
from gsstream.testing import method_driver
from gsstream.testing.common import imports_torch
from gsstream.testing.packet import PacketCodec
from gsstream.testing.registry import (
    CHECKS,
    MIN_REASON,
    Advice,
    Check,
    Skip,
    SourceUnderTest,
    check,
    checks_for,
    expected_failure_of,
    kind_of,
)

Status = Literal["passed", "failed", "warning", "expected failure", "skipped"]
#: Modules of checks: for parts of all kinds, for each kind, for packets; those for commands are here. Importing them
#: fills the registry, in the order of the reports.
MODULES = ("common", *PART_KINDS, "packet")
for _name in MODULES:
    importlib.import_module(f"gsstream.testing.{_name}")


@dataclass(frozen=True, slots=True)
class CheckResult:
    """Outcome of one check on one part. ``message``: numbers of the failure, the advice, or the reason of the skip."""

    check: str
    part: str
    status: Status
    message: str = ""

    @property
    def ok(self) -> bool:
        """Neither failed nor unexpectedly passed."""
        return self.status != "failed"


def run_check(entry: Check, subject: Any, expected: str | None = None) -> CheckResult:
    """Make one check on a subject; ``expected`` says why it must fail (None: it must pass)."""
    name, part = repr(subject), subject
    try:
        if entry.trait is not None and not claimed(subject, entry.trait):
            missing = f"not claimed: {type(subject.claims()).__name__}.{entry.trait}"
            return CheckResult(entry.name, name, "skipped", missing)
        if entry.kind == "method" and isinstance(subject, StreamingMethod):
            subject = method_driver.around(subject)
        with _process_left_alone():
            entry.function(subject)
    except Skip as reason:
        return CheckResult(entry.name, name, "skipped", str(reason))
    except Advice as advice:
        return CheckResult(entry.name, name, "warning", str(advice))
    except AssertionError as error:
        status: Status = "failed" if expected is None else "expected failure"
        return CheckResult(entry.name, name, status, str(error) if expected is None else f"{expected} ({error})")
    except STRANGERS as error:  # a part may raise anything; that is what is being found out
        status = "failed" if expected is None else "expected failure"
        raised = f"raised {type(error).__name__}: {error}{line_of(error, part)}"
        return CheckResult(entry.name, name, status, raised if expected is None else f"{expected} ({raised})")
    if expected is not None:
        return CheckResult(entry.name, name, "failed", f"passed, but was expected to fail: {expected}; drop the entry")
    return CheckResult(entry.name, name, "passed")


@contextmanager
def _process_left_alone() -> Iterator[None]:
    """Raise AssertionError where what happens within changes what the whole process goes by, and set that back."""
    kept = torch.get_default_dtype(), torch.get_num_threads(), os.getcwd()
    try:
        yield
    finally:
        found = torch.get_default_dtype(), torch.get_num_threads(), os.getcwd()
        names = "torch.set_default_dtype", "torch.set_num_threads", "os.chdir"
        changed = [name for name, before, after in zip(names, kept, found, strict=True) if before != after]
        if changed:
            torch.set_default_dtype(kept[0])
            torch.set_num_threads(kept[1])
            os.chdir(kept[2])
            raise AssertionError(f"what the whole process goes by was changed: {', '.join(changed)}; leave that alone")


def claimed(subject: Any, trait: str) -> bool:
    """Say whether a part claims a trait; a claim may be a number, and that number 0.

    Raises AssertionError when its claims are not the record of its kind.
    """
    claims = subject.claims()
    assert hasattr(claims, trait), f"claims(): expected the record of its kind with {trait!r}, got {claims!r}"
    value = getattr(claims, trait)
    return value is not None and value is not False and value != ()


def run_checks(part: Part | SourceUnderTest, expected_failures: Mapping[str, str] | None = None) -> list[CheckResult]:
    """Make every check of the part's kind. Checks that the part itself denies (``Part.denied``) must fail.

    Arguments:
        expected_failures: further checks that must fail -> why, at least 20 characters. Passing is a failure.

    Raises:
        ValueError: an expected failure names no check of this kind, or its reason is none.
    """
    return run_subject(kind_of(part), part, expected_failures)


def skip_checks(kind: str, name: str, reason: str) -> list[CheckResult]:
    """Return the results for a part that cannot be made here: every check of its kind is skipped."""
    return [CheckResult(entry.name, name, "skipped", reason) for entry in checks_for(kind)]


def run_method_checks(name: str, expected_failures: Mapping[str, str] | None = None) -> list[CheckResult]:
    """Make the checks of methods on a named method, with a tiny budget.

    Raises RecipeError, UnknownName or PluginUnavailable when it cannot be assembled.
    """
    return run_subject("method", method_driver.MethodUnderTest(name), expected_failures)


def run_command_checks(spec: CommandSpec, origin: str = "here") -> list[CheckResult]:
    """Make the checks of commands on one that is declared; errors name its ``origin``."""
    return run_subject("command", CommandUnderTest(spec, origin))


def run_packet_checks(codec: PacketCodec | None = None) -> list[CheckResult]:
    """Make the checks of the packet format."""
    return run_subject("packet", codec or PacketCodec())


def run_subject(kind: str, subject: Any, expected: Mapping[str, str] | None = None) -> list[CheckResult]:
    """Make every check of a kind on a method, a packet codec or a source; ``expected``: check -> why it must fail."""
    given = dict(expected or {})
    entries = checks_for(kind)
    _check_reasons(given, [entry.name for entry in entries])
    expected = {**expected_failure_of(subject), **given}
    return [run_check(entry, subject, expected.get(entry.name)) for entry in entries]


def parametrize_with_checks(
    parts: Sequence[Part | SourceUnderTest], expected_failures: Mapping[str, str] | None = None
) -> Callable[[Callable[..., Any]], Any]:
    """Decorate ``def test_contract(check): check()`` to make every check on every part, one test each.

    A check of a claim that a part does not make is no test; one that cannot be made here is a skipped test with its
    reason; an expected failure is an xfail, strictly. Failures of checks that a part denies (``Part.denied``) are
    expected; ``expected_failures`` (check -> reason) adds to it for all of them.
    """
    import pytest

    expected = dict(expected_failures or {})
    known = {entry.name for part in parts for entry in checks_for(kind_of(part))}
    _check_reasons(expected, known)
    cases = []
    for place, part in enumerate(parts):
        reasons = {**expected_failure_of(part), **expected}
        label = type(part).__name__ if len(parts) == 1 else f"{type(part).__name__}{place}"
        for entry in checks_for(kind_of(part)):
            if not _is_test(entry, part):
                continue
            case = functools.partial(_as_test, entry, part, reasons.get(entry.name))
            cases.append(pytest.param(case, id=f"{label}-{entry.name.removeprefix('check_')}"))
    return pytest.mark.parametrize("check", cases)


def _is_test(entry: Check, part: Part | SourceUnderTest) -> bool:
    """Say whether a check is made on a part; claims that cannot be read are for the test to report."""
    try:
        return entry.trait is None or claimed(part, entry.trait)
    except STRANGERS:
        return True


def _as_test(entry: Check, part: Part | SourceUnderTest, expected: str | None) -> None:
    import pytest

    result = run_check(entry, part, expected)
    if result.status == "skipped":
        pytest.skip(result.message)
    if result.status == "expected failure":
        pytest.xfail(result.message)
    if result.status == "warning":
        warnings.warn(result.message, stacklevel=2)
    assert result.ok, f"{entry.name} on {result.part}: {result.message}"


def _check_reasons(expected: Mapping[str, str], known: Iterable[str]) -> None:
    for name, reason in expected.items():
        if name not in known:
            raise ValueError(f"expected_failures: no check named {name!r} is made on this kind of part")
        if len(reason.strip()) < MIN_REASON:
            raise ValueError(
                f"expected_failures[{name!r}]: expected a reason of at least {MIN_REASON} characters, got {reason!r}"
            )


def all_checks() -> list[Check]:
    """Return every registered check, in the order of the reports."""
    return list(CHECKS.values())


def summary(results: Sequence[CheckResult]) -> str:
    """Return "12 passed, 1 failed, 3 skipped": every status that occurs is counted."""
    order: tuple[Status, ...] = ("passed", "failed", "warning", "expected failure", "skipped")
    counts = {status: sum(result.status == status for result in results) for status in order}
    return ", ".join(f"{number} {status}" for status, number in counts.items() if number)


class CommandUnderTest:
    """A declared command; errors name the distribution ``origin``."""

    def __init__(self, spec: CommandSpec, origin: str = "here") -> None:
        self.spec, self._origin = spec, origin

    def __repr__(self) -> str:
        return f"command {self.spec.name}"

    def made(self) -> Any:
        """Return the command that typer makes of the declaration. Raises PluginUnavailable."""
        entry = Entry(self.spec, self._origin, self._origin, "")
        return command_of(self.spec, Catalog({("command", self.spec.name): entry}, ()))


@check("command")
def check_command(subject: CommandUnderTest) -> None:
    """Typer makes a command of it that explains every option; its help begins with its summary and needs no torch."""
    command = subject.made()
    first = (command.help or "").strip().splitlines()[:1]
    assert first == [subject.spec.summary], f"its help begins with {first}, its summary is {subject.spec.summary!r}"
    silent = [f"{name} {option.name}" for name, option in _options(command) if not getattr(option, "help", None)]
    assert not silent, f"these options have no help: {', '.join(silent)}"
    module = subject.spec.target.partition(":")[0]
    heavy = imports_torch(module)
    assert not heavy, f"importing {module}, which --help does, imports torch; import it inside the function: {heavy}"


def _options(command: Any) -> Iterator[tuple[str, Any]]:
    """Every option and argument of a command and of those below it."""
    yield from ((command.name, option) for option in command.params)
    for below in getattr(command, "commands", {}).values():
        yield from _options(below)
