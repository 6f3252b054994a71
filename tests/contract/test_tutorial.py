"""Pages of the documentation, executed from the first block to the last."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest
from fresh import gsstream, install, python

DOCS = Path(__file__).parents[2] / "docs"
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


def follow(page: Path, folder: Path) -> None:
    """Do what a page says, block by block."""
    blocks = BLOCK.findall(page.read_text(encoding="utf-8"))
    assert len(blocks) >= 4
    for language, block in blocks:
        if language == "python":
            write(block, folder)
        elif language == "diff":
            change(block, folder)
        else:
            execute(block, folder, folder / "site")
    assert (folder / "run" / "stream.gss").stat().st_size > 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("page", "plugin"), [("tutorial/first-gate.md", "gsstream-margin"), ("howto/wrap-a-method.md", "gsstream-repaint")]
)
def test_the_page_does_what_it_says(page: str, plugin: str, tmp_path: Path) -> None:
    follow(DOCS / page, tmp_path)
    result = python(tmp_path / "site", "-m", "pytest", "-q", "-p", "no:cacheprovider", plugin, cwd=tmp_path)
    assert result.returncode == 0, result.stdout
