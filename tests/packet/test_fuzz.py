"""A few thousand cases of the fuzzing job (python -m tests.packet.fuzz runs as many as wanted)."""

from __future__ import annotations

import numpy as np
import pytest
from fuzz import Failure, fuzz, play
from fuzz_cases import bases, mutate


def test_thousands_of_mutated_streams_are_refused_or_right():
    summary = fuzz(2000, 5, chunk=1000)
    assert summary["failures"] == []
    outcomes = summary["outcomes"]
    assert sum(outcomes.values()) == 2000
    # Both ends are reached: decoders that notice, and changes that leave a sound stream.
    assert outcomes["sections: refused"] > 500
    assert outcomes["sections: played"] > 20


def test_cases_follow_from_seed_and_number_alone():
    """Whatever was drawn before: another corpus gives the same cases from the last to the first."""
    corpus, other = bases(), bases()
    first = {number: mutate(corpus, 3, number)[:2] for number in range(40)}
    again = {number: mutate(other, 3, number)[:2] for number in reversed(range(40))}
    assert first == again
    assert len({data for _, data in first.values()}) > 35


def test_the_comparison_finds_a_wrong_scene_and_a_lost_frame(tmp_path):
    """The job would be worth nothing if it could not fail."""
    base = bases()[1]
    scenes = list(base.scenes)
    scenes[1] = scenes[1].map(np.zeros_like)
    object.__setattr__(base, "scenes", tuple(scenes))
    with pytest.raises(Failure, match="frame 1 is undamaged"):
        play(tmp_path / "s.gss", base.data, base)
    other = bases()[1]
    object.__setattr__(other, "ends", (*other.ends, other.ends[-1]))
    with pytest.raises(Failure, match="4 frames played, 5 are undamaged"):
        play(tmp_path / "s.gss", other.data, other)
