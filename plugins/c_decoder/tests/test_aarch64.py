"""The decoder in C on another processor, AArch64, by emulation: the whole suite, and what fused products would do."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest
from many_streams import play_all

from gsstream.packet.conformance import judge, load_cases

HERE = Path(__file__).parent
SOURCES = sorted(path for path in (HERE.parent / "src" / "c").glob("*.c") if path.name != "gss_info.c")
CASES = load_cases(HERE.parents[2] / "tests" / "conformance")
STRICT = ("-std=c99", "-Wall", "-Wextra", "-Werror", "-fno-math-errno")
COMPILER, EMULATOR = shutil.which("aarch64-linux-gnu-gcc"), shutil.which("qemu-aarch64")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(COMPILER is None, reason="no aarch64 cross compiler (apt install gcc-aarch64-linux-gnu)"),
    pytest.mark.skipif(EMULATOR is None, reason="no aarch64 emulator (apt install qemu-user)"),
]


def build(program: Path, contract: str) -> list[str]:
    files = [str(path) for path in SOURCES]
    command = [str(COMPILER), "-static", *STRICT, "-O2", f"-ffp-contract={contract}", *files, "-lm", "-o", str(program)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    return [str(EMULATOR), str(program)]


def test_all_vectors_are_played_and_refused(tmp_path: Path) -> None:
    outcomes = play_all(build(tmp_path / "dump", "off"), CASES)
    results = [judge(case, outcome) for case, outcome in zip(CASES, outcomes, strict=True)]
    assert [result for result in results if result.problem or result.left_out] == []


def test_the_suite_notices_products_that_are_fused_with_sums(tmp_path: Path) -> None:
    """This processor has an instruction for both; a build without -ffp-contract=off may use it (R-0.4-1)."""
    rounding = [case for case in CASES if "rounding" in case.features]
    outcomes = play_all(build(tmp_path / "dump", "fast"), rounding)
    assert [case.name for case, outcome in zip(rounding, outcomes, strict=True) if judge(case, outcome).problem]
