"""docs/tutorial/first-gate.md, executed from the first block to the last."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from fresh import gsstream, install, python

PAGE = Path(__file__).parents[2] / "docs" / "tutorial" / "first-gate.md"
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def write(block: str, folder: Path) -> None:
    name, _, text = block.partition("\n")
    target = folder / name.removeprefix("# ")
    assert target.exists(), f"{name} is not one of the files that new-plugin wrote"
    target.write_text(text)


def change(block: str, folder: Path) -> None:
    name, *lines = block.splitlines()
    target = folder / name.removeprefix("# ")
    old, new = (next(line[1:] for line in lines if line.startswith(sign)) for sign in "-+")
    text = target.read_text()
    assert text.count(old) == 1
    target.write_text(text.replace(old, new))


def execute(block: str, folder: Path, site: Path) -> None:
    """Run the commands after ``$``; the lines below one must be in its output, ``exit code`` is 0 unless it says."""
    for text in re.split(r"^\$ ", block, flags=re.MULTILINE)[1:]:
        command, *expected = text.splitlines()
        program, *args = shlex.split(command)
        if program == "pip":
            install(folder / args[-1], site)
            continue
        assert program == "gsstream"
        result = gsstream(site, *args, cwd=folder)
        codes = [line for line in expected if line.startswith("exit code ")]
        wanted = int(codes[0].removeprefix("exit code ")) if codes else 0
        assert result.returncode == wanted, f"{command}: {result.stdout}{result.stderr}"
        for line in expected:
            assert line in codes or line in result.stdout.splitlines(), f"{command}: {line!r} is not in {result.stdout}"


@pytest.mark.slow
def test_first_gate(tmp_path: Path) -> None:
    blocks = BLOCK.findall(PAGE.read_text(encoding="utf-8"))
    assert len(blocks) >= 6
    for language, block in blocks:
        if language == "python":
            write(block, tmp_path)
        elif language == "diff":
            change(block, tmp_path)
        else:
            execute(block, tmp_path, tmp_path / "site")
    assert (tmp_path / "run" / "stream.gss").stat().st_size > 0
    result = python(tmp_path / "site", "-m", "pytest", "-q", "-p", "no:cacheprovider", "gsstream-margin", cwd=tmp_path)
    assert result.returncode == 0, result.stdout
