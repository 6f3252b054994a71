"""What every distribution of this repository says of itself, and that building one twice gives the same bytes."""

from __future__ import annotations

import re
import tarfile
import tomllib
import zipfile
from pathlib import Path
from typing import Any

import pytest
from packaging.requirements import Requirement
from ruamel.yaml import YAML

import gsstream
from gsstream.core.install_hints import ON_INDEX
from tools.dist import PINS, ROOT, SUMS, build, projects

PROJECTS = projects()


def metadata(project: Path) -> dict[str, Any]:
    found: dict[str, Any] = tomllib.loads((project / "pyproject.toml").read_text(encoding="utf-8"))
    return found


@pytest.mark.parametrize("project", PROJECTS, ids=lambda path: path.name)
def test_each_says_what_an_index_shows(project: Path) -> None:
    about = metadata(project)["project"]
    assert about["name"] == "gsstream" or about["name"].startswith("gsstream-")
    for key in ("description", "readme", "requires-python", "authors", "keywords", "classifiers"):
        assert about.get(key), f"{project.name}: {key} is missing"
    assert (about["license"], about["license-files"]) == ("Apache-2.0", ["LICENSE"])
    assert (project / "LICENSE").read_bytes() == (ROOT / "LICENSE").read_bytes()
    assert not any(text.startswith("License ::") for text in about["classifiers"]), "the licence is said by 'license'"


@pytest.mark.parametrize("project", PROJECTS[1:], ids=lambda path: path.name)
def test_each_plugin_asks_for_the_gsstream_it_was_made_with(project: Path) -> None:
    about = metadata(project)["project"]
    (needed,) = [r for r in map(Requirement, about["dependencies"]) if r.name == "gsstream"]
    assert needed.specifier.contains(gsstream.__version__)
    assert not needed.specifier.contains("0.2")
    renders_for_players = "gsstream.player" in about.get("entry-points", {})
    assert ("encoder" in needed.extras) != renders_for_players, "the player must not bring torch"
    assert needed.extras - {"encoder"} == ({"video"} if project.name == "capture" else set())


def test_there_is_a_heading_of_the_changelog_for_this_version() -> None:
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert re.search(rf"^## {re.escape(gsstream.__version__)}\b", text, re.MULTILINE)


def test_what_builds_is_pinned() -> None:
    pins = {Requirement(line).name for line in PINS.read_text().splitlines() if line and not line.startswith("#")}
    for project in PROJECTS:
        named = {Requirement(text).name for text in metadata(project)["build-system"]["requires"]}
        assert named <= pins, f"{project.name}: {named - pins} is not in {PINS.name}"


def test_built_in_another_folder_at_another_time_it_has_the_same_bytes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In this environment, where the backend of the pure distributions is at hand: nothing is fetched."""
    pytest.importorskip("hatchling", reason="hatchling is not installed")
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "1700000000")
    project = ROOT / "plugins" / "ft_pruning"
    sums = [build(tmp_path / name, [project], isolated=False) for name in ("a", "b")]
    assert sums[0] == sums[1]
    assert len(sums[0]) == 2
    listed = (tmp_path / "a" / SUMS).read_text().splitlines()
    assert listed == [f"{digest}  {name}" for name, digest in sums[0].items()]
    (wheel,) = (tmp_path / "a").glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        names = archive.namelist()
        assert {entry.date_time[:3] for entry in archive.infolist()} == {(2023, 11, 14)}
    assert any(name.endswith("licenses/LICENSE") for name in names)
    assert not any("tests/" in name for name in names)
    (source,) = (tmp_path / "a").glob("*.tar.gz")
    with tarfile.open(source) as archive:
        assert any(name.endswith("/tests/test_ft_pruning.py") for name in archive.getnames())
    with pytest.raises(FileExistsError, match="not empty"):
        build(tmp_path / "a", [project], isolated=False)


def test_the_workflow_is_what_make_does() -> None:
    workflow = YAML(typ="safe").load(ROOT / ".github" / "workflows" / "make.yaml")
    targets = re.findall(r"^\.PHONY: (.*)$", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)[0].split()
    steps = [step for job in workflow["jobs"].values() for step in job["steps"]]
    commands = [step["run"] for step in steps if "run" in step]
    assert commands == ["make test", "make dist"]
    assert {command.removeprefix("make ") for command in commands} <= set(targets)
    assert all(set(step) <= {"uses", "with"} for step in steps if "run" not in step)
    assert set(workflow["jobs"]["release"]["needs"]) == {"test", "build"}, "nothing is published that was not tested"


def test_pages_name_extras_that_exist_and_where_they_come_from() -> None:
    extras = metadata(ROOT)["project"]["optional-dependencies"]
    for page in (ROOT / "README.md", ROOT / "docs" / "howto" / "install.md"):
        text = page.read_text(encoding="utf-8")
        told = text.index("the CPU build of torch")
        assert told < text.index("'gsstream[s2gs]'"), "CUDA is 4.7 GB that most machines cannot use"
        for line in re.findall(r"pip install [^`\n]*'gsstream\[(?:\w|,)+\]'", text):
            assert "--find-links dist" in line or ON_INDEX
            assert set(re.findall(r"\[(.*)\]", line)[0].split(",")) <= set(extras)
