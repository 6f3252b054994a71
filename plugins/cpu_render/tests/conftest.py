"""What the tests of this plugin share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from gsstream_cpu_render.threads import num_threads, set_num_threads


@pytest.fixture(params=[1, 2, 3])
def threads(request: pytest.FixtureRequest) -> Iterator[int]:
    """Let a test run with so many threads of the pool."""
    before = num_threads()
    set_num_threads(request.param)
    yield request.param
    set_num_threads(before)
