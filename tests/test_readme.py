"""What the README promises: commands and examples that run, small pictures (all pages: ``test_markdown.py``)."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image
from ruamel.yaml import YAML

from gsstream.discovery.catalog import load_catalog
from gsstream.encode import recipe_for

ROOT = Path(__file__).parents[1]


def blocks(page: str, language: str = "") -> list[str]:
    """Fenced blocks of a page in one language."""
    text = (ROOT / page).read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)


def section(page: str, heading: str) -> str:
    text = (ROOT / page).read_text(encoding="utf-8")
    return text.split(f"\n## {heading}\n")[1].split("\n## ")[0]


def test_the_first_command_is_one_that_make_knows() -> None:
    first, *_ = re.findall(r"^```\n(.*?)^```$", section("README.md", "Start"), re.MULTILINE | re.DOTALL)
    assert first == "make demo\n"
    for target in re.findall(r"make (\w+)", section("README.md", "Start")):
        dry = ["make", "--dry-run", "--no-print-directory", target]
        done = subprocess.run(dry, cwd=ROOT, capture_output=True, text=True, timeout=600, check=False)
        assert done.returncode == 0
        if target == "demo":
            assert done.stdout.splitlines()[-1].endswith('bin/gsstream open runs/demo"')


def test_the_lines_of_a_method_are_those_of_its_recipe() -> None:
    (lines,) = blocks("README.md", "yaml")
    shown = {slot: part["name"] for slot, part in YAML(typ="safe", pure=True).load(lines).items()}
    recipe = recipe_for("s2gs-edge").model_dump()
    assert len(shown) == 4
    assert shown == {slot: recipe[slot]["name"] for slot in shown}


def test_every_method_can_be_chosen() -> None:
    named = set(re.findall(r"`([\w-]+)`", (ROOT / "docs" / "howto" / "choose-a-method.md").read_text(encoding="utf-8")))
    known = {name for kind, name in load_catalog().entries if kind == "method"}
    assert known <= named
    assert len(known) == 20, "the page says 'All twenty', and so does the README"


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
    sizes = re.findall(r"^(\w+) (\d+) bytes$", encoding.stdout, re.MULTILINE)
    assert [status for status, _ in sizes] == ["key", "delta", "delta"]
    played = re.findall(r"^frame (\d): (\d+) Gaussians, (\d+) bytes$", playing.stdout, re.MULTILINE)
    assert [(frame, size) for frame, _, size in played] == [(str(t), size) for t, (_, size) in enumerate(sizes)]
    with Image.open(tmp_path / "last.png") as image:
        assert image.size == (160, 120)
        assert max(high for _, high in image.getextrema()) > 100


def test_the_readme_is_short_and_the_pictures_are_small() -> None:
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= 1000
    pictures = [path for path in (ROOT / "docs").rglob("*") if path.suffix in (".png", ".jpg", ".webp", ".gif")]
    film = ROOT / "docs" / "images" / "film.webp"
    assert sum(path.stat().st_size for path in pictures if path != film) < 300_000
    assert film.stat().st_size <= 2_500_000


def test_the_film_is_an_animation_of_about_a_minute() -> None:
    with Image.open(ROOT / "docs" / "images" / "film.webp") as film:
        stays = []
        for place in range(film.n_frames):
            film.seek(place)
            film.load()
            stays.append(film.info["duration"])
    assert 50_000 <= sum(stays) <= 75_000
