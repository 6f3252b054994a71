"""Copies: their number stays that of the key packet, by those that leave."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from gsstream.engine.run.encoder import EncodedFrame
from gsstream.parts.growth.copying import Copies
from gsstream.parts.update.none import NoUpdate
from gsstream.testing import MethodUnderTest


def steps_with(**settings: Any) -> list[EncodedFrame]:
    method = MethodUnderTest("dense")
    config = Copies.Config.model_validate({"gradient": 1e-7, "rounds": 1, "most": 7, "prune_opacity": 0.0, **settings})
    method.assembly = replace(method.assembly, growth=Copies(config), update=NoUpdate())
    return method.steps


@pytest.mark.parametrize("leave", ["least-opaque", "last-added"])
def test_as_many_leave_as_the_frame_before_added(leave: str) -> None:
    first, second, third = steps_with(leave=leave)
    number, before = len(first.state.player.gaussians), second.state.player
    assert [step.metrics["added_gaussians"] for step in (second, third)] == [7, 7]
    assert [step.metrics["removed_gaussians"] for step in (second, third)] == [0, 7]
    assert [len(step.state.player.gaussians) for step in (second, third)] == [number + 7, number + 7]
    opacities = before.gaussians.opacities
    wanted = np.argsort(opacities, kind="stable")[:7] if leave == "least-opaque" else np.arange(number, number + 7)
    assert sorted(third.state.player.delta.removed) == sorted(wanted)


def test_without_passes_nothing_is_added() -> None:
    assert [step.status for step in steps_with(epochs=0)] == ["key", "empty", "empty"]
