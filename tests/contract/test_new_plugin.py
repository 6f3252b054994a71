"""``gsstream new-plugin``: what it writes installs, passes every check untouched, and overwrites nothing."""

from __future__ import annotations

from pathlib import Path

import pytest
from fresh import gsstream, install, python

from gsstream.cli.main import run_command
from gsstream.cli.scaffold import STARTABLE


@pytest.mark.parametrize("kind", STARTABLE)
def test_passes_the_contract_untouched(kind: str, tmp_path: Path) -> None:
    project, site = tmp_path / "project", tmp_path / "site"
    assert run_command(["new-plugin", "my-own", "--kind", kind, "--out", str(project)]) == 0
    install(project, site)
    result = gsstream(site, "check", f"{kind}/my-own", cwd=tmp_path)
    assert result.returncode == 0, result.stdout + result.stderr
    assert f"{kind} my-own (from gsstream-my-own 0.1.0)" in result.stdout
    skipped = [line.split()[1] for line in result.stdout.splitlines() if "(skipped)" in line]
    assert skipped == ([] if kind == "source" else ["auto_rules"]), "only settings that a scene could choose"
    assert "✓ cheap_spec" in result.stdout
    if kind == "stepper":  # a whole method, which its recipe makes one of --method
        result = gsstream(site, "check", "method/my-own", cwd=tmp_path)
        assert result.returncode == 0, result.stdout + result.stderr
        assert "(skipped)" not in result.stdout
        shown = gsstream(site, "recipe", "show", "my-own", cwd=tmp_path)
        assert "method: my-own" in shown.stdout, shown.stderr


def test_its_own_test_suite_and_lint_are_green(tmp_path: Path) -> None:
    project, site = tmp_path / "project", tmp_path / "site"
    assert run_command(["new-plugin", "my_own", "--kind", "gate", "--out", str(project)]) == 0
    install(project, site)
    result = python(site, "-m", "pytest", "-p", "no:cacheprovider", "tests", cwd=project)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "24 passed" in result.stdout
    lint = python(site, "-m", "ruff", "check", "--isolated", "--line-length=120", "--select=E,F,B", ".", cwd=project)
    assert lint.returncode == 0, lint.stdout


def test_refuses_bad_names_taken_names_and_full_folders(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "mine").write_text("kept")
    for args, message in (
        (["Bad Name", "--out", str(tmp_path / "a")], "expected lower case letters"),
        (["always-open", "--out", str(tmp_path / "a")], "the gate 'always-open' is already provided by gsstream"),
        (["fine", "--out", str(tmp_path)], "is not an empty folder"),
        (["fine", "--out", str(tmp_path / "mine")], "is not an empty folder"),
    ):
        assert run_command(["new-plugin", *args]) == 2
        assert message in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["mine"]
    assert (tmp_path / "mine").read_text() == "kept"
