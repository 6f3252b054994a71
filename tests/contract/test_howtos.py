"""Pages of the documentation, executed: every how-to keeps its contract, tutorials from end to end."""

from __future__ import annotations

import re
import shlex
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from fresh import gsstream, install, python

from gsstream.core.kinds import CONTRACTS
from gsstream.core.part import Part
from gsstream.discovery.catalog import load_catalog
from gsstream.discovery.discovery import Discovered
from gsstream.engine.run.recording import open_recording
from gsstream.input.recordings.prefetch import Prefetcher
from gsstream.recipe.model import Recipe
from gsstream.spec import ComponentSpec
from gsstream.testing import run_checks
from gsstream.testing.registry import BEHAVED, kind_of

HOWTOS = Path(__file__).parents[2] / "docs" / "howto"
PAGES = {
    "structure": "write-a-structure", "confidence": "write-a-confidence", "propagation": "write-a-propagation",
    "regularizer": "write-a-regularizer", "update": "write-an-update-rule", "motion": "write-a-motion",
    "growth": "write-a-growth", "renderer": "write-a-renderer",
}  # fmt: skip


def module(page: str, monkeypatch: pytest.MonkeyPatch) -> types.ModuleType:
    """The one Python block of a page, as an importable module."""
    (code,) = re.findall(r"^```python\n(.*?)^```$", (HOWTOS / f"{page}.md").read_text(), re.MULTILINE | re.DOTALL)
    made = types.ModuleType(page.replace("-", "_"))
    monkeypatch.setitem(sys.modules, made.__name__, made)
    exec(compile(code, f"{page}.md", "exec"), vars(made))
    return made


@pytest.mark.parametrize("kind", PAGES)
def test_the_example_passes_every_check_of_its_kind(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    made = module(PAGES[kind], monkeypatch)
    classes = [value for value in vars(made).values() if isinstance(value, type) and issubclass(value, Part)]
    (cls,) = [value for value in classes if value.__module__ == made.__name__]
    part = cls()
    assert kind_of(part) == kind
    results = run_checks(part)
    assert [f"{result.check}: {result.message}" for result in results if not result.ok] == []
    skipped = {result.check for result in results if result.status == "skipped"}
    # The page's motion corrects nothing, so it finds no body that moves in another way than before.
    unclaimed = {"motion": {"check_motion_finds_bodies"}}.get(kind, set())
    assert skipped == {"check_cheap_spec"} | unclaimed, "the example claims all that can be claimed"
    assert len(results) > (15 if kind in BEHAVED else 2)


def test_there_is_a_page_for_every_kind_with_a_contract() -> None:
    elsewhere = {"streaming_method", "gate"}  # whole methods and gates have pages of their own
    assert {*PAGES, *elsewhere} >= set(CONTRACTS)


def test_the_source_is_read_like_any_other(monkeypatch: pytest.MonkeyPatch) -> None:
    made = module("write-a-source", monkeypatch)
    spec = ComponentSpec(kind="source", name="square", target=f"{made.__name__}:Square", summary="a square")
    catalog = load_catalog([Discovered("square", "gsstream-square", "1", (spec,))])
    source = open_recording("square:any", Recipe(), catalog)
    with Prefetcher(source, range(5)) as pairs:
        for index, (train, test) in enumerate(pairs):
            train.validate()
            test.validate()
            assert np.array_equal(train.images, source.frame(index).images)
    assert index == 4


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


def test_a_recipe_with_a_name_is_a_method(tmp_path: Path) -> None:
    page = (HOWTOS / "name-a-method.md").read_text(encoding="utf-8")
    for language, name, text in re.findall(r"^```(\w+)\n# (\S+)\n(.*?)^```$", page, re.MULTILINE | re.DOTALL):
        assert Path(name).suffix == {"toml": ".toml", "python": ".py", "yaml": ".yaml"}[language]
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text, encoding="utf-8")
    commands = [block for language, block in BLOCK.findall(page) if language == "console"]
    assert len(commands) == 1
    execute(commands[0], tmp_path, tmp_path / "site")
    shown = gsstream(tmp_path / "site", "methods", "mine", cwd=tmp_path).stdout
    assert "rigid motion, then every Gaussian" in shown
    assert "stream.epochs" in shown
