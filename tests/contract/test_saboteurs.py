"""Every check can fail, and fails for its own reason: for each there is a part that fails it alone."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from distribution import write_metadata
from pydantic import Field
from saboteurs import COMMAND_SABOTEURS, INSTALLED, METHOD_SABOTEURS, PACKET_SABOTEURS, SABOTEURS

from gsstream.cli.check import _part_subject
from gsstream.core.context import FrameContext
from gsstream.core.part import PartConfig
from gsstream.parts.confidence.base import ConfidenceEstimator
from gsstream.testing import MethodUnderTest
from gsstream.testing.kit import (
    CheckResult,
    all_checks,
    run_checks,
    run_command_checks,
    run_method_checks,
    run_packet_checks,
    run_subject,
)


def failed(results: list[CheckResult]) -> dict[str, str]:
    return {result.check: result.message for result in results if result.status in ("failed", "warning")}


def test_every_check_has_a_saboteur_and_every_saboteur_a_check() -> None:
    names = {entry.name for entry in all_checks()}
    assert names == {*SABOTEURS, *PACKET_SABOTEURS, *METHOD_SABOTEURS, *COMMAND_SABOTEURS, *INSTALLED}
    assert len(names) == sum(map(len, (SABOTEURS, PACKET_SABOTEURS, METHOD_SABOTEURS, COMMAND_SABOTEURS, INSTALLED)))


@pytest.mark.parametrize("check", SABOTEURS)
def test_fails_exactly_its_check(check: str) -> None:
    results = run_checks(SABOTEURS[check]())
    found = failed(results)
    assert set(found) == {check}
    assert all(result.ok for result in results) == (check == "check_citation"), "house style is a warning"
    # A part that raises is caught by whatever check calls it first; a property is missed with numbers or names.
    assert len(found[check]) > 20
    if check == "check_rejects_nonfinite":
        assert "was nan" in found[check], "which input held it is said"


def test_a_part_that_leaves_the_process_fails_its_checks() -> None:
    class Leaving(ConfidenceEstimator):
        source = "gsstream"

        def estimate(self, context: FrameContext) -> torch.Tensor:
            sys.exit(0)

    found = failed(run_checks(Leaving(Leaving.Config())))
    assert len(found) > 5
    assert any("SystemExit: 0" in said for said in found.values()), found


def test_a_part_whose_settings_refuse_their_own_default_fails_in_a_sentence() -> None:
    class Refusing(ConfidenceEstimator):
        source = "gsstream"

        class Config(PartConfig):
            gain: float = Field(default=1000.0, le=100, description="of nothing")

    (result,) = _part_subject("confidence", "refusing", "heading", Refusing, None).results
    assert (result.check, result.status) == ("construction", "failed")
    assert result.message.startswith("with its default settings: ValidationError: ")
    assert "gain" in result.message


@pytest.mark.parametrize(
    "leak",
    [lambda: torch.set_default_dtype(torch.float64), lambda: torch.set_num_threads(3), lambda: os.chdir("/")],
    ids=["dtype", "threads", "folder"],
)
def test_a_part_that_changes_the_process_fails_and_the_process_is_set_back(leak: Callable[[], None]) -> None:
    class Leaking(ConfidenceEstimator):
        source = "gsstream"

        def estimate(self, context: FrameContext) -> torch.Tensor:
            leak()
            return torch.zeros_like(context.gaussians.opacities)

    torch.set_num_threads(1)
    before = torch.get_default_dtype(), torch.get_num_threads(), os.getcwd()
    found = failed(run_checks(Leaking(Leaking.Config())))
    assert (torch.get_default_dtype(), torch.get_num_threads(), os.getcwd()) == before
    assert any("what the whole process goes by was changed" in said for said in found.values()), found


@pytest.mark.parametrize("check", PACKET_SABOTEURS)
def test_packets_fail_exactly_their_check(check: str) -> None:
    results = run_packet_checks(PACKET_SABOTEURS[check])
    assert set(failed(results)) == {check}


@pytest.mark.parametrize("check", COMMAND_SABOTEURS)
def test_commands_fail_exactly_their_check(check: str) -> None:
    found = failed(run_command_checks(COMMAND_SABOTEURS[check]))
    assert set(found) == {check}
    assert "imports torch" in found[check]


@pytest.mark.parametrize("check", METHOD_SABOTEURS)
def test_methods_fail_exactly_their_check(check: str) -> None:
    results = run_subject("method", METHOD_SABOTEURS[check]("dense"))
    assert set(failed(results)) == {check}


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
    write_metadata(tmp_path, "gsstream-heavy", "0.1", "[gsstream]\nheavy = gsstream_heavy_plugin\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    try:
        found = failed(run_checks(ExampleGate()))
    finally:
        sys.modules.pop("gsstream_heavy_plugin", None)
    assert set(found) == {"check_cheap_spec"}
    assert "imports torch" in found["check_cheap_spec"]
