"""What the tests of this plugin share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from gsstream_cpu_render import _native
from gsstream_cpu_render.threads import num_threads, set_num_threads


@pytest.fixture(autouse=True)
def _restore_native_settings() -> Iterator[None]:
    isa, threads = _native.active_isa(), num_threads()
    yield
    _native.select_isa(isa)
    set_num_threads(threads)


@pytest.fixture(params=_native.supported_isas())
def isa(request: pytest.FixtureRequest) -> str:
    """Let a test run with each instruction set that this processor has."""
    _native.select_isa(request.param)
    return str(request.param)


@pytest.fixture(params=[1, 2, 3])
def threads(request: pytest.FixtureRequest) -> int:
    """Let a test run with so many threads of the pool."""
    set_num_threads(request.param)
    return int(request.param)
