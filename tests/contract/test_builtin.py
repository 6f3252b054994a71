"""The parts that ship with gsstream, and the examples that new plugins start from, keep the contract."""

from __future__ import annotations

import pytest
import torch

from gsstream.api import Traits
from gsstream.confidence.uniform import Uniform
from gsstream.gate.always_open import AlwaysOpen
from gsstream.loss.photometric import ReferenceLoss
from gsstream.method.hold import Hold
from gsstream.optimiser.adam import ReferenceAdam
from gsstream.propagation.group_max import GroupMax
from gsstream.regularizer.none import NoRegularizer
from gsstream.render.reference import ReferenceRenderer
from gsstream.residual.additive import Additive
from gsstream.source.open import open_source
from gsstream.structure.flat import Flat
from gsstream.testing import SourceUnderTest, parametrize_with_checks, run_checks
from gsstream.testing.examples.confidence import ExampleConfidence
from gsstream.testing.examples.gate import ExampleGate
from gsstream.testing.examples.loss import ExampleLoss
from gsstream.testing.examples.propagation import ExamplePropagation
from gsstream.testing.examples.regularizer import ExampleRegularizer
from gsstream.testing.examples.source import ExampleSource
from gsstream.testing.examples.structure import ExampleStructure
from gsstream.testing.examples.update import ExampleUpdate
from gsstream.testing.examples.whole import ExampleWhole
from gsstream.testing.kit import all_checks, summary

BUILTIN = [
    Flat(), Uniform(), Uniform(Uniform.Config(logit=-50)), GroupMax(), AlwaysOpen(), NoRegularizer(), Additive(),
    ReferenceRenderer(), ReferenceLoss(), ReferenceAdam(), Hold(),
]  # fmt: skip
EXAMPLES = [ExampleStructure(), ExampleConfidence(), ExamplePropagation(), ExampleGate(), ExampleRegularizer()]
EXAMPLES += [ExampleWhole(), ExampleUpdate(), ExampleLoss()]
TINY = "synthetic:frames=4&views=3&width=32&height=24&supersample=1"
SOURCES = [SourceUnderTest(ExampleSource, "square:"), SourceUnderTest(open_source, "demo")]
SOURCES += [SourceUnderTest(open_source, TINY)]


@parametrize_with_checks([*BUILTIN, *EXAMPLES, *SOURCES])
def test_contract(check) -> None:
    check()


def test_every_part_that_is_declared_is_checked_here() -> None:
    from gsstream.core.kinds import CONTRACTS
    from gsstream.plugins.builtin import gsstream_components

    declared = {spec.target.rpartition(":")[2] for spec in gsstream_components() if spec.kind in CONTRACTS}
    assert declared == {type(part).__name__ for part in BUILTIN}


def test_examples_claim_enough_for_every_check_of_the_five_kinds_to_run() -> None:
    results = [result for part in [*EXAMPLES, SOURCES[0]] for result in run_checks(part)]
    skipped = {result.check: result.message for result in results if result.status == "skipped"}
    assert set(skipped) == {"check_cheap_spec", "check_auto_rules"}, skipped


def test_a_known_failure_needs_a_reason_and_must_still_fail() -> None:
    with pytest.raises(ValueError, match="at least 20 characters"):
        run_checks(AlwaysOpen(), {"check_gate_monotone": "FIXME"})
    with pytest.raises(ValueError, match="no check named 'check_nothing'"):
        run_checks(AlwaysOpen(), {"check_nothing": "there is no such check anywhere"})
    results = run_checks(AlwaysOpen(), {"check_gate_monotone": "said to fail, but it does not at all"})
    [result] = [r for r in results if not r.ok]
    assert result.check == "check_gate_monotone"
    assert "passed, but was expected to fail" in result.message


def test_skips_are_counted_and_say_which_claim_is_missing() -> None:
    results = run_checks(AlwaysOpen())
    skipped = [r for r in results if r.status == "skipped"]
    assert all(r.message.startswith(("not claimed: Traits.", "offers no 'auto'")) for r in skipped)
    assert summary(results) == f"{len(results) - len(skipped)} passed, {len(skipped)} skipped"


def test_names_and_meanings_of_checks() -> None:
    checks = all_checks()
    assert len(checks) > 50
    for entry in checks:
        assert entry.meaning.endswith((".", ")")), f"{entry.name}: {entry.meaning!r} is no sentence"
        if entry.trait:
            assert hasattr(Traits(), entry.trait)
    assert not torch.is_inference_mode_enabled()
