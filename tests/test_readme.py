"""What the README promises: two commands, examples that run, a small picture (all pages: ``test_markdown.py``)."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image

ROOT = Path(__file__).parents[1]


def blocks(page: str, language: str = "") -> list[str]:
    """Fenced blocks of a page in one language."""
    text = (ROOT / page).read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def section(page: str, heading: str) -> str:
    text = (ROOT / page).read_text(encoding="utf-8")
    return text.split(f"\n## {heading}\n")[1].split("\n## ")[0]


def test_the_quick_start_is_two_commands_that_make_knows() -> None:
    (commands,) = re.findall(r"^```\n(.*?)^```$", section("README.md", "Quick start"), re.MULTILINE | re.DOTALL)
    assert commands.splitlines() == ["make demo", "make test"]
    for target in ("demo", "test"):
        dry = ["make", "--dry-run", "--no-print-directory", target]
        done = subprocess.run(dry, cwd=ROOT, capture_output=True, text=True, timeout=600, check=False)
        assert done.returncode == 0
        if target == "demo":
            assert done.stdout.splitlines()[-1].endswith('bin/gsstream open runs/demo"')


def test_the_tutorial_says_which_environment_it_means() -> None:
    """Its commands are found only in an active one, and the system's pip would look for gsstream in an index."""
    said = (ROOT / "docs" / "tutorial" / "first-gate.md").read_text(encoding="utf-8")
    (folder,) = re.findall(r"source (\S+)/bin/activate", said)
    assert f"VENV := {folder}\n" in (ROOT / "Makefile").read_text(encoding="utf-8")


@pytest.mark.slow
def test_the_python_examples_encode_and_play(tmp_path: Path) -> None:
    examples = blocks("README.md", "python")
    assert [len(example.splitlines()) <= 10 for example in examples] == [True, True]
    encoding, playing = (
        subprocess.run(
            [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=600, check=False
        )
        for code in examples
    )
    assert encoding.returncode == 0, encoding.stderr
    assert playing.returncode == 0, playing.stderr
    sizes = re.findall(r"^frame (\d): (\d+) bytes, (\w+), \{", encoding.stdout, re.MULTILINE)
    assert [(frame, status) for frame, _, status in sizes] == [("0", "key"), ("1", "delta"), ("2", "delta")]
    played = re.findall(r"^frame (\d): (\d+) Gaussians, (\d+) bytes$", playing.stdout, re.MULTILINE)
    assert [(frame, size) for frame, _, size in played] == [(frame, size) for frame, size, _ in sizes]
    with Image.open(tmp_path / "last.png") as image:
        assert image.size == (160, 120)
        assert max(high for _, high in image.getextrema()) > 100


def test_the_readme_is_short_and_the_pictures_are_small() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 120
    pictures = [path for path in (ROOT / "docs").rglob("*") if path.suffix in (".png", ".jpg", ".webp", ".gif")]
    assert sum(path.stat().st_size for path in pictures) < 300_000
