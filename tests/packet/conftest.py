"""Fixtures of the packet tests."""

from __future__ import annotations

import tracemalloc

import pytest

LIMIT = 32 << 20


@pytest.fixture
def bounded_memory():
    tracemalloc.start()
    yield
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < LIMIT
