"""3DGStream keeps the contract of parts and of whole methods."""

from __future__ import annotations

import pytest
from gsstream_stream3dgs import plugin
from gsstream_stream3dgs.method import Stream3DGS
from gsstream_stream3dgs.settings import BirthSettings, CacheSettings, Stream3DGSConfig

from gsstream.testing import parametrize_with_checks
from gsstream.testing.kit import run_method_checks

#: The kit gives a frame one or two passes: then something moves and something is born in it.
EAGER = Stream3DGSConfig(
    cache=CacheSettings(levels=4, entries=8, width=8, lr=0.02, box=0.0),
    births=BirthSettings(gradient=1e-6, rounds=1, most=9),
)


CELLS = EAGER.model_copy(update={"cache": EAGER.cache.model_copy(update={"sent": "cells"})})


@parametrize_with_checks([Stream3DGS(EAGER), Stream3DGS(CELLS)])
def test_contract(check) -> None:
    check()


@pytest.mark.parametrize("name", [spec.name for spec in plugin.gsstream_methods()])
def test_its_methods(name: str) -> None:
    assert [result for result in run_method_checks(name) if not result.ok] == []
