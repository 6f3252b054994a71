"""Each instruction set that this processor has keeps the contract, with one thread and with four.

The kernels of aarch64 run under an emulator in ``test_cross_aarch64.py``.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import pytest
from gsstream_cpu_render import _native
from gsstream_cpu_render.renderer import CpuRenderer
from gsstream_cpu_render.threads import num_threads, set_num_threads

from gsstream.testing import parametrize_with_checks

LACKING = [name for name in ("baseline", "avx2", "avx512", "neon", "mmx") if name not in _native.supported_isas()]
#: Checks of what the kernels compute. The others are about classes and settings, which have no instruction set.
NUMBERS = ("renderer_", "loss_", "optimiser_", "residual_")


def checks_of_numbers() -> list[Any]:
    made: Any = parametrize_with_checks([CpuRenderer()])
    cases = made.args[1]
    return [case for case in cases if case.id.partition("-")[2].startswith(NUMBERS)]


@pytest.mark.parametrize("count", [1, 4])
@pytest.mark.parametrize("check", checks_of_numbers())
def test_contract(isa: str, count: int, check: Callable[[], None]) -> None:
    set_num_threads(count)
    check()
    assert (_native.active_isa(), num_threads()) == (isa, count)


def chosen(name: str, call: str = "_native.active_isa()") -> subprocess.CompletedProcess[str]:
    code = f"from gsstream_cpu_render import _native, threads; print({call})"
    environment = {**os.environ, "GSSTREAM_ISA": name}
    return subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=60)


@pytest.mark.parametrize("name", _native.supported_isas())
def test_the_environment_chooses(name: str) -> None:
    assert chosen(name).stdout.strip() == name


@pytest.mark.parametrize("name", LACKING)
def test_a_set_that_the_processor_lacks_is_refused(name: str) -> None:
    sets = ", ".join(_native.supported_isas())
    assert f"ValueError: GSSTREAM_ISA: expected one of {{{sets}}}" in chosen(name).stderr
    assert f"got '{name}'" in chosen(name).stderr


def test_python_code_gets_the_error_of_a_wrong_setting() -> None:
    assert "InputError: GSSTREAM_ISA: expected one of" in chosen("mmx", "threads.instruction_set()").stderr
