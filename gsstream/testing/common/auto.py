"""What a part that offers ``auto`` promises: its rules choose, from whatever scene, something it accepts."""

from __future__ import annotations

import itertools
from typing import Any

from pydantic import ValidationError

from gsstream.core.auto import Choice, SceneFacts
from gsstream.core.kinds import CONTRACTS
from gsstream.core.part import Part
from gsstream.engine.assembly.assemble import with_values
from gsstream.testing.registry import Skip, check


def extreme_scenes() -> list[SceneFacts]:
    """Return facts at the ends of their ranges, in every combination that matters, and an everyday scene."""
    everyday = SceneFacts(12, 320, 240, 12_000, 1000.0, 900.0, 20.0, (2.0, 1.5, 1.0, 0.8, 0.5), 0.2, (0.3, 0.3, 0.1))
    none, gains = (0.0,) * 5, ((0.0, 0.0, 0.0), (-5.0, -9.0, -20.0), (3.0, 6.0, 9.0))
    spans = ((0.0, 1.0, 1.0, none), (1e9, 1e9, float("inf"), (9.0, 9.0, 9.0, 9.0, 9.0)), (5.0, 3.0, 1.0, none))
    rigs = ((1, 1, 1, 1), (200, 8000, 6000, 10**7))
    return [everyday] + [
        SceneFacts(*rig, *span, texture, gain)
        for rig, span, texture, gain in itertools.product(rigs, spans, (0.0, 1.0), gains)
    ]


@check("common", kinds=tuple(CONTRACTS))
def check_auto_rules(part: Part) -> None:
    """Each rule of ``auto`` gives a value that the settings accept, others to try, a reason, and the same each time."""
    if not part.auto_rules:
        raise Skip("offers no 'auto'")
    for facts, (key, rule) in itertools.product(extreme_scenes(), part.auto_rules.items()):
        choice = rule(facts, part.config)
        assert isinstance(choice, Choice), f"rule for {key}: expected a Choice, got {type(choice).__name__}"
        assert choice.why.strip(), f"rule for {key}: expected a reason, got {choice.why!r}"
        again = rule(facts, part.config)
        assert again == choice, f"rule for {key}: the same scene gave {choice.value!r}, then {again.value!r}"
        for value in {choice.value, *choice.ladder}:
            _check_accepted(part, key, value, facts)


def _check_accepted(part: Part, key: str, value: Any, facts: SceneFacts) -> None:
    values = with_values(part.config.model_dump(), {key: value})
    try:
        part.Config.model_validate(values)
    except ValidationError as error:
        reason = error.errors(include_url=False)[0]["msg"]
        raise AssertionError(f"rule for {key} chose or would try {value!r} for {facts}: {reason}") from error
