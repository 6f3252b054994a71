"""``gsstream new-plugin``: what it writes installs, passes every check untouched, and overwrites nothing."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from fresh import install, python

from gsstream.cli.main import run_command
from gsstream.cli.scaffold import STARTABLE

#: Commands in a process that has a plugin of every kind; what each prints goes with its exit code to one JSON file.
ALL = """
import contextlib, io, json, sys
from gsstream.cli.main import run_command
results = {}
for command in json.loads(sys.argv[1]):
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(io.StringIO()) as err:
        code = run_command(command.split())
    results[command] = [code, out.getvalue(), err.getvalue()]
with open(sys.argv[2], "w") as file:
    json.dump(results, file)
"""


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[int, str, str]]:
    """Command -> (exit code, stdout, stderr), in one fresh process: most of the time of one is that it starts."""
    folder = tmp_path_factory.mktemp("new")
    for kind in STARTABLE:
        assert run_command(["new-plugin", f"my-{kind}", "--kind", kind, "--out", str(folder / kind)]) == 0
        install(folder / kind, folder / "site")
    commands = [f"check {kind}/my-{kind}" for kind in STARTABLE]
    commands += ["check method/my-streaming_method", "recipe my-streaming_method"]  # a whole method is one of --method
    done = python(folder / "site", "-c", ALL, json.dumps(commands), str(folder / "results.json"), cwd=folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return json.loads((folder / "results.json").read_text())


@pytest.mark.parametrize("kind", STARTABLE)
def test_passes_the_contract_untouched(kind: str, results: dict[str, tuple[int, str, str]]) -> None:
    code, out, err = results[f"check {kind}/my-{kind}"]
    assert code == 0, out + err
    assert f"{kind} my-{kind} (from gsstream-my-{kind} 0.1.0)" in out
    skipped = [line.split()[1] for line in out.splitlines() if "(skipped)" in line]
    assert skipped == []
    assert "✓ cheap_spec" in out


def test_a_whole_method_is_one_of_the_methods(results: dict[str, tuple[int, str, str]]) -> None:
    code, out, err = results["check method/my-streaming_method"]
    assert code == 0, out + err
    assert "(skipped)" not in out
    _, out, err = results["recipe my-streaming_method"]
    assert "method: my-streaming_method" in out, err


def test_its_own_test_suite_and_lint_are_green(tmp_path: Path) -> None:
    project, site = tmp_path / "project", tmp_path / "site"
    assert run_command(["new-plugin", "my_own", "--kind", "gate", "--out", str(project)]) == 0
    install(project, site)
    result = python(site, "-m", "pytest", "-p", "no:cacheprovider", "tests", cwd=project)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "26 passed in" in result.stdout, "all but the check of formulas, which this gate does not state"
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
