"""ReCon-GS keeps the contract of parts and of whole methods."""

from __future__ import annotations

import pytest
from gsstream_recon import plugin
from gsstream_recon.method import ReCon
from gsstream_recon.settings import BirthSettings, MotionSettings, ReConConfig

from gsstream.testing import parametrize_with_checks
from gsstream.testing.kit import run_method_checks

#: The kit gives a frame one or two passes: then something moves and something is born in it.
EAGER = ReConConfig(
    motion=MotionSettings(measure="anchor", change=6.0, step=0.02, turn_step=0.002),
    births=BirthSettings(gradient=1e-6, rounds=1, most=9),
)


@parametrize_with_checks([ReCon(EAGER)])
def test_contract(check) -> None:
    check()


@pytest.mark.parametrize("name", [spec.name for spec in plugin.gsstream_methods()])
def test_its_methods(name: str) -> None:
    assert [result for result in run_method_checks(name) if not result.ok] == []
