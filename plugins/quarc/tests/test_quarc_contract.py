"""QuARC-GS keeps the contract of parts and of whole methods."""

from __future__ import annotations

import pytest
from gsstream_quarc import plugin
from gsstream_quarc.method import QuARC
from gsstream_quarc.settings import GateSettings, QuARCConfig
from gsstream_recon.settings import BirthSettings, MotionSettings

from gsstream.testing import parametrize_with_checks
from gsstream.testing.kit import run_method_checks

#: The kit gives a frame one or two passes: then something moves and something is born in it.
EAGER = QuARCConfig(
    motion=MotionSettings(measure="anchor", change=6.0, step=0.02, turn_step=0.002),
    births=BirthSettings(gradient=1e-6, rounds=1, most=9),
    gate=GateSettings(score=0.1),
)


@parametrize_with_checks([QuARC(EAGER)])
def test_contract(check) -> None:
    check()


@pytest.mark.parametrize("name", [spec.name for spec in plugin.gsstream_methods()])
def test_its_methods(name: str) -> None:
    assert [result for result in run_method_checks(name) if not result.ok] == []
