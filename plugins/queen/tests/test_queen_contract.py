"""QUEEN keeps the contract of parts and of whole methods, with births and without."""

from __future__ import annotations

import pytest
from gsstream_queen import plugin
from gsstream_queen.method import Queen
from gsstream_queen.settings import BirthSettings, ChangeSettings, QueenConfig

from gsstream.testing import parametrize_with_checks
from gsstream.testing.kit import run_method_checks

#: The kit gives a frame one epoch: then something must be born after it.
EASY = ChangeSettings(dynamic=1e-8)
FERTILE = BirthSettings(every=1, after=0, until=1, gradient=1e-6, most=20)


OTHER = QueenConfig(births=FERTILE, rows="dynamic", change=EASY, rate=1e-3, sigma=1e-4)


@parametrize_with_checks([Queen(), Queen(OTHER)])
def test_contract(check) -> None:
    check()


@pytest.mark.parametrize("name", [spec.name for spec in plugin.gsstream_methods()])
def test_its_methods(name: str) -> None:
    assert [result for result in run_method_checks(name) if not result.ok] == []
