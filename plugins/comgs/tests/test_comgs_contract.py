"""ComGS keeps the contract of parts and of whole methods."""

from __future__ import annotations

import pytest
from gsstream_comgs import plugin
from gsstream_comgs.method import ComGS
from gsstream_comgs.settings import ComGSConfig, CorrectionSettings, MotionSettings

from gsstream.testing import parametrize_with_checks
from gsstream.testing.kit import run_method_checks

#: The kit gives a frame one pass, and has three frames: then all of them are corrected.
EAGER = ComGSConfig(
    motion=MotionSettings(keypoints=20, step=0.02, change=0.0),
    correction=CorrectionSettings(every=1, passes=1, step=1e-3),
)


@parametrize_with_checks([ComGS(EAGER)])
def test_contract(check) -> None:
    check()


@pytest.mark.parametrize("name", [spec.name for spec in plugin.gsstream_methods()])
def test_its_methods(name: str) -> None:
    assert [result for result in run_method_checks(name) if not result.ok] == []
