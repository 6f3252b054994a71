"""The examples that new plugins start from keep the contract, and what shipped parts claim of it."""

from __future__ import annotations

from dataclasses import fields
from math import log
from typing import Any, final

import pytest
import torch

from gsstream.core.kinds import PART_KINDS
from gsstream.discovery.catalog import load_catalog
from gsstream.input.recordings.open import open_source
from gsstream.parts.confidence.uniform import Uniform
from gsstream.parts.gate.always_open import AlwaysOpen
from gsstream.parts.gate.base import GateSampler
from gsstream.parts.structure.flat import Flat
from gsstream.testing import SourceUnderTest, parametrize_with_checks, run_checks
from gsstream.testing.examples.confidence import ExampleConfidence
from gsstream.testing.examples.gate import ExampleGate
from gsstream.testing.examples.propagation import ExamplePropagation
from gsstream.testing.examples.regularizer import ExampleRegularizer
from gsstream.testing.examples.source import ExampleSource
from gsstream.testing.examples.streaming_method import ExampleMethod
from gsstream.testing.examples.structure import ExampleStructure
from gsstream.testing.examples.update import ExampleUpdate
from gsstream.testing.kit import all_checks, summary

EXAMPLES = [ExampleStructure(), ExampleConfidence(), ExamplePropagation(), ExampleGate(), ExampleRegularizer()]
EXAMPLES += [ExampleMethod(), ExampleUpdate()]
TINY = "synthetic:frames=4&views=3&width=32&height=24&supersample=1"
#: A setting that matters, and a source whose shortest recording is none.
OTHERS = [Uniform(Uniform.Config(logit=-50)), SourceUnderTest(open_source, TINY)]


@parametrize_with_checks(OTHERS)
def test_contract(check) -> None:
    check()


def test_examples_pass_every_check_and_claim_enough_for_all_of_them_to_run() -> None:
    """But that of how a plugin declares them: none does."""
    results = [result for part in [*EXAMPLES, SourceUnderTest(ExampleSource, "square:")] for result in run_checks(part)]
    assert [f"{result.part} {result.check}: {result.message}" for result in results if not result.ok] == []
    skipped = {result.check: result.message for result in results if result.status == "skipped"}
    assert set(skipped) == {"check_cheap_spec"}, skipped


def test_a_known_failure_needs_a_reason_and_must_still_fail() -> None:
    with pytest.raises(ValueError, match="at least 20 characters"):
        run_checks(AlwaysOpen(), {"check_gate_monotone": "FIXME"})
    with pytest.raises(ValueError, match="no check named 'check_nothing'"):
        run_checks(AlwaysOpen(), {"check_nothing": "there is no such check anywhere"})
    results = run_checks(AlwaysOpen(), {"check_gate_monotone": "said to fail, but it does not at all"})
    [result] = [r for r in results if not r.ok]
    assert result.check == "check_gate_monotone"
    assert "passed, but was expected to fail" in result.message


@final
class Denier(GateSampler):
    """A gate that denies what ``denied`` says."""

    source = "this test"

    @property
    def num_levels(self) -> int:
        return 1

    def init(self, logits: torch.Tensor) -> torch.Tensor:
        return torch.zeros_like(logits)

    def noise(self, num_nodes: int, generator: torch.Generator) -> torch.Tensor | None:
        return None

    def sample(self, logits: torch.Tensor, noise: torch.Tensor | None) -> torch.Tensor:
        return torch.full_like(logits, 0.5)

    def open_probability(self, logits: torch.Tensor) -> torch.Tensor:
        return torch.ones_like(logits)

    def bound(self, logits: torch.Tensor) -> torch.Tensor:
        return logits


def test_what_a_part_denies_is_expected_everywhere(monkeypatch: pytest.MonkeyPatch) -> None:
    honest = {
        "check_gate_range_and_levels": "half a gate is no multiple of one, on purpose",
        "check_gate_extremes": "a gate that is always half open never opens fully",
    }
    found = {result.check for result in run_checks(Denier()) if not result.ok}
    assert found == set(honest)
    monkeypatch.setattr(Denier, "denied", honest)
    results = {result.check: result for result in run_checks(Denier())}
    assert all(result.ok for result in results.values())
    assert results["check_gate_extremes"].status == "expected failure"
    cases = parametrize_with_checks([Denier()]).args[1]
    by_name = {case.id: case.values[0] for case in cases}
    with pytest.raises(pytest.xfail.Exception, match="always half open"):
        by_name["Denier-gate_extremes"]()


@pytest.mark.parametrize(
    ("denied", "check", "message"),
    [
        ({"check_gate_monotone": "it is monotone, whatever is said here"}, "check_gate_monotone", "passed, but"),
        ({"check_structure_forest": "a gate has no forest to speak of"}, "check_denials", "made on a gate"),
        ({"check_gate_extremes": "todo"}, "check_denials", "at least 20 characters, got 'todo'"),
    ],
)
def test_denials_that_are_not_true_are_failures(
    monkeypatch: pytest.MonkeyPatch, denied: dict[str, str], check: str, message: str
) -> None:
    monkeypatch.setattr(Denier, "denied", denied)
    failed = {result.check: result.message for result in run_checks(Denier()) if not result.ok}
    assert message in failed[check]


def test_claims_of_another_kind_are_a_failure_and_no_crash(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Denier, "claims", lambda self: Flat().claims())
    failed = {result.check: result.message for result in run_checks(Denier()) if not result.ok}
    assert "expected the record of its kind with 'stochastic', got StructureTraits" in failed["check_gate_calibration"]


def test_skips_are_counted_and_say_which_claim_is_missing() -> None:
    results = run_checks(AlwaysOpen())
    skipped = [r for r in results if r.status == "skipped"]
    assert all(r.message.startswith("not claimed: GateTraits.") for r in skipped)
    assert summary(results) == f"{len(results) - len(skipped)} passed, {len(skipped)} skipped"
    tests = [case.id for case in parametrize_with_checks([AlwaysOpen()]).args[1]]
    made = [r.check.removeprefix("check_") for r in results if r.status != "skipped"]
    assert tests == [f"AlwaysOpen-{name}" for name in made]


def test_names_and_meanings_of_checks() -> None:
    checks = all_checks()
    assert len(checks) > 50
    for entry in checks:
        assert entry.meaning.endswith((".", ")")), f"{entry.name}: {entry.meaning!r} is no sentence"
        if entry.trait:
            assert hasattr(PART_KINDS[entry.kind].contract_class().traits, entry.trait)
    assert not torch.is_inference_mode_enabled()


#: Part with its default settings -> what it claims beyond the record of its kind; parts of other kinds claim nothing.
CLAIMS: dict[str, dict[str, Any]] = {
    "confidence/error-gradient": {"needs_renderer": True, "floor": 1.0},
    "confidence/uniform": {"brightness": 0.0},
    "confidence/uniform-random": {"floor": log(1e3)},
    "confidence/view-gradient": {
        "needs_renderer": True, "floor": log(1e-3), "finds_motion": True, "monotone_in_change": True,
        "brightness": 2.0,
    },
    "gate/always-open": {},
    "gate/binary-ste": {"stochastic": True, "differentiable": True, "temperature": True},
    "gate/gumbel-sigmoid": {"stochastic": True, "differentiable": True, "temperature": True},
    "motion/hicom": {"finds_motion": True, "momentum": 0.6},
    "motion/keypoints": {"finds_motion": True, "momentum": 0.0},
    "motion/recon": {"finds_motion": True, "momentum": 0.6},
    "motion/rigid": {"finds_motion": True, "momentum": 1.0},
    "motion/still": {"momentum": 0.0},
    "motion/stream3dgs": {},
    "propagation/ft-pruning": {"idempotent": True, "differentiable": True, "parent_bound": True},
    "propagation/group-max": {"conservative": True, "idempotent": True, "differentiable": True, "normalised": True},
    "propagation/hierarchical-max": {
        "conservative": True, "idempotent": True, "differentiable": True, "normalised": True, "parent_bound": True,
    },
    "regularizer/expected-sparsity": {
        "differentiable": True, "weights": ("lambda1", "lambda2"), "gate_terms": ("sparsity",),
    },
    "regularizer/none": {},
    "structure/flat": {"idempotent": True, "local": True, "has_grid": False},
    "structure/octree": {"idempotent": True, "local": True},
}  # fmt: skip
#: Parts that cannot be made from their default settings.
UNBUILT = {"confidence/onnx"}


def test_no_shipped_part_claims_more_or_less_than_here() -> None:
    catalog, found = load_catalog(), {}
    for (kind, part), entry in catalog.entries.items():
        name = f"{kind}/{part}"
        if kind not in PART_KINDS or not entry.distribution.startswith("gsstream") or name in UNBUILT:
            continue
        if PART_KINDS[kind].contract is None or not fields(PART_KINDS[kind].contract_class().traits):
            continue
        claims = catalog.resolve(kind, part)().claims()
        plain = type(PART_KINDS[kind].contract_class().traits)()
        both = {field.name: (getattr(claims, field.name), getattr(plain, field.name)) for field in fields(claims)}
        found[name] = {claim: said for claim, (said, unsaid) in both.items() if said != unsaid}
    assert found == CLAIMS
