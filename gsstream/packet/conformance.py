"""The conformance suite of docs/spec: stored streams with a hash for each frame, held against any decoder.

A decoder is a program that is called with the path of a stream. It prints a line for each frame, ``INDEX HASH``, then
ends with exit code 0; or it prints a line ``refused WHY`` and ends with another exit code; or, where it has no fields,
``unsupported field``. A line ``without meta`` before all others says that it does not read the meta.
The rules that WHY cites are compared. tests/conformance/README.md is the whole contract.
"""

from __future__ import annotations

import hashlib
import json
import re
import subprocess
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from gsstream.core.errors import InputError, PacketError
from gsstream.core.gaussians import Gaussians
from gsstream.core.shapes import FloatArray
from gsstream.packet.base import PacketKind
from gsstream.packet.reader import StreamReader, key_offsets, parse_index
from gsstream.packet.state import PlayerState, decode_packet

#: Seconds that a program may take for one stream; the largest has some hundred kilobytes.
TIMEOUT = 60
#: How a decoder cites a rule of docs/spec.
_RULE = re.compile(r"\bR-\d+(?:\.\d+)?-\d+\b")
#: What a decoder may leave out (section 0.6 of docs/spec).
OPTIONAL = frozenset({"field", "meta"})


@dataclass(frozen=True, slots=True)
class Case:
    """One stream of the suite.

    Arguments:
        name: name of the case.
        path: file of its stream.
        features: abilities that a decoder needs for the case; the one that the case tests comes first.
        rules: identifiers of docs/spec that it tests.
        frames: the lines that a decoder prints, one for each frame that can be played.
        refused: whether the stream is refused after these frames.
    """

    name: str
    path: Path
    features: tuple[str, ...]
    rules: tuple[str, ...]
    frames: tuple[str, ...]
    refused: bool


class Outcome(NamedTuple):
    """What a decoder printed for a stream, and its exit code."""

    lines: tuple[str, ...]
    code: int


@dataclass(frozen=True, slots=True)
class Result:
    """Result of a decoder at a case: ``problem`` is None where it was right, or left out what it may leave out."""

    case: Case
    problem: str | None = None
    left_out: bool = False


def load_cases(folder: Path) -> list[Case]:
    """Return the cases of a folder that has vectors.json. Raises InputError where that is missing or damaged."""
    listed = folder / "vectors.json"
    try:
        said = json.loads(listed.read_text(encoding="utf-8"))
        cases = [_case(folder, name, values) for name, values in said.items()]
    except FileNotFoundError as error:
        raise InputError(f"no vectors: expected {listed}; name the folder of the suite with --vectors DIR") from error
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{listed}: not a list of vectors: {type(error).__name__}: {error}") from error
    missing = [case.path for case in cases if not case.path.is_file()]
    if missing:
        raise InputError(f"{listed} names {len(missing)} streams that are not there, the first is {missing[0]}")
    return cases


def _case(folder: Path, name: str, said: dict[str, object]) -> Case:
    file, features, rules, frames = (said[key] for key in ("file", "features", "rules", "frames"))
    first = said["first"]
    if not (isinstance(file, str) and isinstance(first, int)):
        raise TypeError(f"file and first of {name}")
    if not (isinstance(frames, list) and isinstance(features, list) and isinstance(rules, list)):
        raise TypeError(f"frames, features and rules of {name}")
    lines = tuple(f"{index} {digest}" for index, digest in enumerate(frames, first))
    return Case(name, folder / file, tuple(features), tuple(rules), lines, refused=file.startswith("refuse/"))


def frame_hash(gaussians: Gaussians[FloatArray]) -> str:
    """Return the hash of a frame (section 0.5 of docs/spec)."""
    return hashlib.sha256(b"".join(array.astype("<f4").tobytes() for _, array in gaussians.items())).hexdigest()


def play_here(path: Path) -> Outcome:
    """Return what the decoder of this package makes of a stream."""
    lines: list[str] = []
    try:
        with StreamReader(path) as reader:
            _play(reader, lines)
    except PacketError as error:
        return Outcome((*lines, f"refused {error}"), 1)
    return Outcome(tuple(lines), 0)


def _play(reader: StreamReader, lines: list[str]) -> None:
    state: PlayerState | None = None
    for entry, data in reader:
        if entry.kind == PacketKind.INDEX:
            if parse_index(data, entry.offset) != key_offsets(reader.entries):
                raise PacketError("the index does not describe this stream", entry.offset)
            continue
        state = decode_packet(state, data, offset=entry.offset)
        lines.append(f"{entry.frame} {frame_hash(state.gaussians)}")
    if state is None:
        raise PacketError("the stream holds no complete key packet", reader.end)


def cite(folder: Path, outcome: Outcome) -> Outcome:
    """Return what a decoder printed with the rule behind its refusal, which messages.json of a suite knows.

    Decoders of this repository say what is wrong in words, for who uses them; the suite knows which rule that is.
    """
    if not outcome.lines or not outcome.lines[-1].startswith("refused "):
        return outcome
    known: list[tuple[str, list[str]]] = json.loads((folder / "messages.json").read_text(encoding="utf-8"))
    why = re.sub(r" \(at byte \d+\)$", "", outcome.lines[-1])
    rules = next((rules for words, rules in known if re.search(words, why)), ["R-0.1-1"])
    return Outcome((*outcome.lines[:-1], f"{outcome.lines[-1]} {' '.join(rules)}"), outcome.code)


def play_with(program: Sequence[str]) -> Callable[[Path], Outcome]:
    """Return a decoder that runs a program with the path of a stream behind its own arguments."""

    def play(path: Path) -> Outcome:
        try:
            done = subprocess.run(
                [*program, str(path)], capture_output=True, text=True, errors="replace", timeout=TIMEOUT, check=False
            )
        except OSError as error:
            raise InputError(f"cannot run {program[0]!r}: {error.strerror}") from error
        except subprocess.TimeoutExpired:
            return Outcome((f"no end after {TIMEOUT} seconds",), -1)
        return Outcome(tuple(done.stdout.splitlines()), done.returncode)

    return play


def judge(case: Case, outcome: Outcome) -> Result:
    """Return how what a decoder printed compares with what it should have printed."""
    lines, last = list(outcome.lines), ""
    without: set[str] = set()
    while lines and lines[0].startswith("without "):
        without.add(lines.pop(0).removeprefix("without "))
    may = OPTIONAL & set(case.features)
    if case.refused and without & may:
        return Result(case, left_out=True)
    if lines and not lines[-1][:1].isdigit():
        last = lines.pop()
    word, _, feature = last.partition(" ")
    for number, (got, wanted) in enumerate(zip(lines, case.frames, strict=False)):
        if got != wanted:
            return Result(case, f"line {number + 1}: expected {wanted!r}, got {got[:90]!r}")
    if len(lines) > len(case.frames):
        return Result(case, f"expected {len(case.frames)} frames, got {len(lines)}: {lines[len(case.frames)][:90]!r}")
    if word == "unsupported" and feature in may and outcome.code != 0:
        return Result(case, left_out=True)
    if len(lines) < len(case.frames):
        return Result(case, f"expected {len(case.frames)} frames, got {len(lines)}, then {last[:90]!r}")
    ended = "refused" if word == "refused" and outcome.code > 0 else f"exit code {outcome.code} after {last[:90]!r}"
    if case.refused and ended != "refused":
        return Result(case, f"expected it to be refused by {' '.join(case.rules)}, got {ended}")
    cited = set(_RULE.findall(last)) if case.refused else set()
    if cited and cited.isdisjoint(case.rules):
        return Result(case, f"expected it to be refused by {' or '.join(case.rules)}, got {' or '.join(sorted(cited))}")
    if not case.refused and (last or outcome.code):
        return Result(case, f"expected it to be played to its end, got {ended}")
    return Result(case)


def by_feature(results: Iterable[Result]) -> list[tuple[str, int, int, int, int]]:
    """Return feature, cases, passed, left out, failed, for every feature and at last for all; a case counts in each."""
    found: dict[str, list[Result]] = {}
    every = list(results)
    for result in every:
        for feature in result.case.features:
            found.setdefault(feature, []).append(result)
    rows = [*sorted(found.items()), ("all", every)]
    return [(name, len(some), *_counts(some)) for name, some in rows]


def _counts(results: Sequence[Result]) -> tuple[int, int, int]:
    left_out = sum(result.left_out for result in results)
    failed = sum(result.problem is not None for result in results)
    return len(results) - left_out - failed, left_out, failed
