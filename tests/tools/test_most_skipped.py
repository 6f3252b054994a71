"""The limit of skipped tests that continuous integration sets (``conftest.py``)."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

TESTS = """
import pytest
skip = pytest.mark.skip
@skip(reason="node is not installed (apt install nodejs)")
def test_a(): ...
@skip(reason="no page (apt install nodejs chromium)")
def test_b(): ...
@skip(reason="needs a GPU")
def test_c(): ...
def test_d(): ...
"""


@pytest.mark.parametrize("workers", [[], ["-n", "1"]], ids=["alone", "worker"])
@pytest.mark.parametrize(("most", "code"), [("2", 1), ("3", 0), (None, 0)])
def test_more_skipped_than_may_be_fails_and_says_what_to_install(
    tmp_path: Path, most: str | None, code: int, workers: list[str]
) -> None:
    (tmp_path / "test_some.py").write_text(TESTS)
    limit = ["--most-skipped", most] if most else []
    command = [sys.executable, "-m", "pytest", "-p", "conftest", *limit, *workers, "test_some.py"]
    root = Path(__file__).parents[2]
    environment = {"PYTHONPATH": str(root), "PATH": "/usr/bin:/bin", "HOME": str(tmp_path)}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == code, done.stdout + done.stderr
    assert "To run the rest: apt install nodejs chromium\n" in done.stdout
    assert ("FAILED: 3 tests were skipped; at most 2 may be\n" in done.stdout) == (code == 1)
    assert done.stdout.splitlines()[-1].startswith(("1 passed, 3 skipped in", "====")), done.stdout
