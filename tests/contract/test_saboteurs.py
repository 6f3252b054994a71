"""Every check can fail, and fails for its own reason: the table check x saboteur, and the page that shows it."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

from gsstream.testing.kit import CheckResult, all_checks, run_checks, run_method_checks, run_packet_checks, run_subject
from gsstream.testing.saboteurs import INSTALLED, METHOD_SABOTEURS, PACKET_SABOTEURS, SABOTEURS, saboteur_of
from gsstream.testing.stepping import MethodUnderTest


def failed(results: list[CheckResult]) -> dict[str, str]:
    return {result.check: result.message for result in results if not result.ok}


def column(results: list[CheckResult]) -> dict[str, str]:
    """check -> its mark, as the page writes them."""
    marks = {"failed": "✗", "passed": "·", "skipped": "–"}
    return {result.check: marks[result.status] for result in results}


def read_page() -> dict[str, dict[str, str]]:
    """The check that a saboteur is for -> its column in docs/reference/saboteurs.md."""
    columns = {}
    for table in TEXT.split("\n## ")[1:]:
        rows = [re.findall(r"[^|\s]+", line) for line in table.splitlines() if line.startswith("| `")]
        for number, check in re.findall(r"^(\d+)\. for `(\w+)`", table, re.MULTILINE):
            columns[check] = {row[0].strip("`"): row[int(number)] for row in rows}
    return columns


TEXT = (Path(__file__).parents[2] / "docs" / "reference" / "saboteurs.md").read_text(encoding="utf-8")
PAGE = read_page()


def test_the_page_shows_every_saboteur() -> None:
    """When it is stale: python -m tools.reference --saboteurs"""
    assert set(PAGE) == {*SABOTEURS, *PACKET_SABOTEURS, *METHOD_SABOTEURS}
    for check in PAGE:
        assert f"for `{check}`: {saboteur_of(check)}" in TEXT


def test_every_check_has_a_saboteur_and_every_saboteur_a_check() -> None:
    names = {entry.name for entry in all_checks()}
    assert names == {*SABOTEURS, *PACKET_SABOTEURS, *METHOD_SABOTEURS, *INSTALLED}
    assert len(names) == sum(map(len, (SABOTEURS, PACKET_SABOTEURS, METHOD_SABOTEURS, INSTALLED)))


@pytest.mark.parametrize("check", SABOTEURS)
def test_fails_exactly_its_check(check: str) -> None:
    results = run_checks(SABOTEURS[check]())
    found = failed(results)
    assert set(found) == {check}
    assert column(results) == PAGE[check]
    # A part that raises is caught by whatever check calls it first; a property is missed with numbers or names.
    assert len(found[check]) > 20


@pytest.mark.parametrize("check", PACKET_SABOTEURS)
def test_packets_fail_exactly_their_check(check: str) -> None:
    results = run_packet_checks(PACKET_SABOTEURS[check])
    assert set(failed(results)) == {check}
    assert column(results) == PAGE[check]


@pytest.mark.parametrize("check", METHOD_SABOTEURS)
def test_methods_fail_exactly_their_check(check: str) -> None:
    results = run_subject("method", METHOD_SABOTEURS[check]("dense"))
    assert set(failed(results)) == {check}
    assert column(results) == PAGE[check]


def test_the_real_packets_and_the_baseline_pass() -> None:
    assert failed(run_packet_checks()) == {}
    assert failed(run_method_checks("dense")) == {}
    assert repr(MethodUnderTest("dense")) == "method dense"


HEAVY = """
import torch
from gsstream.spec import ComponentSpec, hookimpl

assert torch


@hookimpl
def gsstream_components():
    target = "gsstream.testing.examples.gate:ExampleGate"
    return [ComponentSpec(kind="gate", name="heavy", target=target, summary="declared by a module that imports torch")]
"""


def test_a_plugin_whose_declaration_imports_torch_fails_exactly_that(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from gsstream.testing.examples.gate import ExampleGate

    (tmp_path / "gsstream_heavy_plugin.py").write_text(HEAVY)
    info = tmp_path / "gsstream_heavy-0.1.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: gsstream-heavy\nVersion: 0.1\n")
    (info / "entry_points.txt").write_text("[gsstream]\nheavy = gsstream_heavy_plugin\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    try:
        found = failed(run_checks(ExampleGate()))
    finally:
        sys.modules.pop("gsstream_heavy_plugin", None)
    assert set(found) == {"check_cheap_spec"}
    assert "imports torch" in found["check_cheap_spec"]

