"""The suite of docs/spec on both decoders, its own completeness, and that it notices a decoder that is wrong."""

from __future__ import annotations

import functools
import json
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsstream.core.changes import motion
from gsstream.core.changes import residual as residual_change
from gsstream.core.errors import InputError
from gsstream.packet.conformance import Case, Outcome, by_feature, cite, judge, load_cases, play_here, play_with

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
sys.path.insert(0, str(HERE.parent / "web"))
from node_runs import NODE, needs_node, play_in_node  # noqa: E402 - the folder is known only now

CASES = load_cases(HERE)
RULE = re.compile(r"R-\d+(?:\.\d+)?-\d+")


@functools.cache
def rules() -> set[str]:
    pages = (page.read_text(encoding="utf-8") for page in (ROOT / "docs" / "spec").glob("*.md"))
    return {rule for text in pages for rule in re.findall(rf"\[({RULE.pattern})\]", text)}


def test_this_decoder_plays_and_refuses_all_streams() -> None:
    problems = [result for case in CASES if (result := judge(case, cite(HERE, play_here(case.path)))).problem]
    assert problems == []


@needs_node
def test_the_browsers_decoder_plays_and_refuses_all_streams(tmp_path: Path) -> None:
    found = play_in_node([case.path.read_bytes() for case in CASES], tmp_path)["streams"]
    results = []
    for case, stream in zip(CASES, found, strict=True):
        first = int(case.frames[0].split()[0]) if case.frames else 0
        lines = [f"{index} {digest}" for index, digest in enumerate(stream["digests"], first)]
        error = stream["error"]
        if error is not None:
            assert error["expected"], (case.name, error)
            lines.append(f"refused {error['message']}")
        results.append(judge(case, cite(HERE, Outcome(tuple(lines), int(error is not None)))))
    assert [result for result in results if result.problem or result.left_out] == []


@needs_node
@pytest.mark.parametrize(
    "name", ["file-with-index", "cut-in-a-body", "packet-body-damaged", "field-marked", "file-empty"]
)
def test_a_program_is_run_by_the_contract(name: str) -> None:
    (case,) = (case for case in CASES if case.name == name)
    result = judge(case, play_with([str(NODE), str(HERE / "javascript.mjs")])(case.path))
    assert (result.problem, result.left_out) == (None, False)


def test_the_suite_is_small_and_each_stream_is_listed() -> None:
    files = {path for folder in ("play", "refuse") for path in (HERE / folder).iterdir()}
    assert files == {case.path for case in CASES}
    assert sum(not case.refused for case in CASES) >= 100
    assert sum(path.stat().st_size for path in [*files, HERE / "vectors.json"]) <= 2_000_000
    assert max(path.stat().st_size for path in files) <= 60_000


def test_every_rule_has_a_stream_or_a_test_that_is_named() -> None:
    cited = {rule for case in CASES for rule in case.rules}
    assert cited <= rules()
    table = (HERE / "README.md").read_text(encoding="utf-8").split("## Rules without a stream\n")[1]
    others: set[str] = set()
    for row in table.splitlines():
        if named := RULE.findall(row):
            others |= set(named)
            places = re.findall(r"`(tests/[^`]+)`", row)
            assert all((ROOT / place).exists() for place in places), row
            assert places or "`refuse/`" in row or "`field`" in row, row
    assert cited | others == rules()
    assert cited & others == set()
    refused = {rule for case in CASES if case.refused for rule in case.rules}
    must_refuse = [rule for rule in rules() - others if rule not in refused]
    # What is left says how things are computed or what is played, not what is refused.
    assert sorted(must_refuse) == sorted(PLAYED)


#: Rules that no stream can break: they say how a value comes about, or that something is played.
PLAYED = [
    "R-0.4-1",
    "R-0.5-1",
    "R-1.1-5",
    "R-1.6-1",
    "R-2.5-1",
    "R-3.2-9",
    "R-4.3-1",
    "R-4.4-6",
]


def altered(case: Case) -> list[Outcome]:
    """What decoders print that are wrong in one thing."""
    sound, code = list(case.frames), int(case.refused)
    end = ["refused"] if case.refused else []
    wrong = [
        Outcome((*sound, "0 " + "0" * 64, *end), code),
        Outcome((*sound, *([] if case.refused else ["refused"])), 1 - code),
        Outcome((*sound, *end), 1 - code),
        Outcome((*sound, "unsupported telepathy"), 3),
        Outcome((*sound, "Segmentation fault"), -11),
        Outcome((*sound, "refused"), -11),
    ]
    if sound:
        index, digest = sound[-1].split()
        wrong += [
            Outcome((*sound[:-1], *end), code),
            Outcome((*sound[:-1], f"{int(index) + 1} {digest}", *end), code),
            Outcome((*sound[:-1], f"{index} {digest[::-1]}", *end), code),
            Outcome((*sound[:-1], f"{index}", *end), code),
        ]
    return wrong


@pytest.mark.parametrize("case", CASES[::37], ids=lambda case: case.name)
def test_a_decoder_that_is_wrong_fails(case: Case) -> None:
    assert (
        judge(case, Outcome((*case.frames, *(["refused"] if case.refused else [])), int(case.refused))).problem is None
    )
    for outcome in altered(case):
        assert judge(case, outcome).problem is not None, outcome


def test_a_decoder_may_leave_out_the_meta_and_the_field_and_nothing_else() -> None:
    by_name = {case.name: case for case in CASES}
    meta, sound, rows = (by_name[name] for name in ("meta-nan", "meta-compressed", "rows-nobody-leaves"))
    more = "1 " + "0" * 64
    assert judge(meta, Outcome(("without meta", *meta.frames, more), 0)).left_out
    assert judge(meta, Outcome((*meta.frames, more), 0)).problem
    found = judge(sound, Outcome(("without meta", *sound.frames), 0))
    assert (found.problem, found.left_out) == (None, False)
    assert judge(rows, Outcome(("without rows", *rows.frames, more), 0)).problem
    assert judge(rows, Outcome((*rows.frames, "unsupported rows"), 3)).problem
    assert judge(by_name["field-marked"], Outcome((by_name["field-marked"].frames[0], "unsupported field"), 3)).left_out


def wide_residual(symbols: Any, step: float, decoder: Any) -> Any:
    """As gsstream.core.changes.residual.decode_residual, in float64 with one rounding at the end."""
    latent = symbols.astype(np.float64) * float(np.float32(step))
    return (latent if decoder is None else latent @ decoder.astype(np.float64)).astype(np.float32)


def backwards(values: Any, group: Any, number: int) -> Any:
    """As the means of gsstream.core.changes.motion, with rows added up from the last to the first."""
    return MEANS(values[::-1], group[::-1], number)


def sparing(gaussians: Any, stored: Any, residual: Any) -> Any:
    """As apply_residual, for a decoder that leaves alone what does not change but for the sign of 0."""
    after = APPLY(gaussians, stored, residual)
    same = {n: np.where(a == getattr(gaussians, n), getattr(gaussians, n), a) for n, a in after.items()}
    return replace(after, **same)


def flushing(gaussians: Any, stored: Any, residual: Any) -> Any:
    """As apply_residual, for a processor that takes subnormal numbers for 0."""
    after = APPLY(gaussians, stored, residual)
    return after.map(lambda a: np.where(np.abs(a) < np.finfo(np.float32).tiny, np.float32(0), a))


MEANS, APPLY = motion.group_means, residual_change.apply_residual
WRONG = {
    "core.changes.residual.decode_residual": wide_residual,
    "core.changes.motion.group_means": backwards,
    "core.changes.delta.apply_residual": sparing,
}


@pytest.mark.parametrize(("place", "function"), [*WRONG.items(), ("core.changes.delta.apply_residual", flushing)])
def test_the_suite_notices_arithmetic_of_another_order_or_width(
    monkeypatch: pytest.MonkeyPatch, place: str, function: Any
) -> None:
    monkeypatch.setattr(f"gsstream.{place}", function)
    cases = [case for case in CASES if {"rounding", "extremes", "decoder"} & set(case.features)]
    assert [case for case in cases if judge(case, play_here(case.path)).problem]


def test_a_refusal_for_another_reason_fails() -> None:
    """A decoder may refuse the right streams for wrong reasons; where it cites rules it is told so."""
    for case in (case for case in CASES if case.refused):
        others = sorted(rules() - set(case.rules))
        for cited, is_right in ((case.rules[0], True), (f"{others[0]} {case.rules[-1]}", True), (others[0], False)):
            found = judge(case, Outcome((*case.frames, f"refused by {cited}: why"), 1))
            assert (found.problem is None) == is_right, (case.name, cited)
        unknown = cite(HERE, Outcome((*case.frames, "refused what nobody says (at byte 3)"), 1))
        assert "got R-0.1-1" in str(judge(case, unknown).problem)


def test_every_row_of_the_table_of_messages_is_needed_and_names_rules_that_exist() -> None:
    known = json.loads((HERE / "messages.json").read_text())
    assert {rule for _, named in known for rule in named} <= rules()
    assert all(RULE.search(words) is None for words, _ in known)
    assert len({words for words, _ in known}) == len(known)


def test_the_table_counts_every_stream_once_for_each_feature() -> None:
    results = [judge(case, Outcome((), 0)) for case in CASES]
    rows = by_feature(results)
    assert rows[-1][:2] == ("all", len(CASES))
    assert sum(row[1] for row in rows[:-1]) == sum(len(case.features) for case in CASES)
    assert all(row[1] == sum(row[2:]) for row in rows)


def test_a_program_that_is_not_there_or_never_ends_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    case = CASES[0]
    with pytest.raises(InputError, match="cannot run 'no-such-program'"):
        play_with(["no-such-program"])(case.path)
    monkeypatch.setattr("gsstream.packet.conformance.TIMEOUT", 0.2)
    found = play_with([sys.executable, "-c", "import time; time.sleep(20)"])(case.path)
    assert "no end" in str(judge(case, found).problem)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        '{"a": 1}',
        '{"a": {"file": "play/x.gss"}}',
        '{"a": {"file": 3, "features": [], "rules": [], "frames": [], "first": 0}}',
    ],
)
def test_a_damaged_list_of_vectors_is_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(InputError, match="no vectors"):
        load_cases(tmp_path)
    (tmp_path / "vectors.json").write_text(text)
    with pytest.raises(InputError, match="not a list of vectors"):
        load_cases(tmp_path)
    entry = {"file": "play/x.gss", "features": [], "rules": [], "frames": [], "first": 0}
    (tmp_path / "vectors.json").write_text(json.dumps({"x": entry}))
    with pytest.raises(InputError, match="not there"):
        load_cases(tmp_path)
