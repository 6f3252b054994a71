"""What a user can give wrong: one clear message on stderr, a non-zero exit, and nothing already written is lost."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import textwrap
from collections.abc import Callable
from pathlib import Path

import pytest
from distribution import write_metadata
from flow_runs import WORLD, arguments, demo_copy, encode, finish, metrics

from gsstream.cli.main import run_command

ROOT = Path(__file__).parents[2]


def refused(capsys: pytest.CaptureFixture[str], command: list[str], code: int = 2) -> str:
    """The one line that a refused command prints."""
    assert run_command(command) == code
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: ")
    # A run that fails later on also says what there is and how to go on.
    assert len([line for line in err.splitlines() if not line.startswith("the stream in ")]) == 1, err
    return err.removeprefix("error: ")


def singular(folder: Path) -> str:
    data = json.loads((folder / "cameras.json").read_text())
    data["cameras"][1]["K"] = [[0, 0, 80], [0, 150, 60], [0, 0, 1]]
    (folder / "cameras.json").write_text(json.dumps(data))
    return "camera 'cam01' are not invertible"


def lost(folder: Path) -> str:
    (folder / "cam01" / "000002.jpg").unlink()
    return "camera 'cam01': frame 2 is missing (1 of 3 "


@pytest.mark.parametrize("spoil", [singular, lost])
def test_a_recording_that_cannot_be_read_leaves_no_folder_behind(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], spoil: Callable[[Path], str]
) -> None:
    """Before anything is trained. Every fault and its words: tests/input/recordings/test_source_multiview.py."""
    folder = demo_copy(tmp_path / "r")
    message = spoil(folder)
    assert message in refused(capsys, arguments(tmp_path / "o", source=str(folder)))
    assert not (tmp_path / "o").exists()


def test_a_folder_with_another_run_is_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    encode(tmp_path, "--frames", "1")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    err = refused(capsys, arguments(tmp_path))
    assert "already holds a run (stream.gss, metrics.jsonl, recipe.yaml, recording.txt)" in err
    assert "--resume" in err
    assert "--overwrite" in err
    # Whatever else is wrong is found before --overwrite deletes anything.
    for wrong in (["--source", "dmo"], ["--set", "gate=gat"], ["--first-frame", "absent.gss"]):
        refused(capsys, [*arguments(tmp_path, "--overwrite"), *wrong])
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


BLOCKED = """
import sys
from importlib.abc import MetaPathFinder

class Missing(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name == "gsstream_cpu_render._native":
            raise ImportError("no compiled module for this Python")

sys.meta_path.insert(0, Missing())
"""


def test_without_the_native_module_everything_works_slowly_after_one_warning(tmp_path: Path) -> None:
    (tmp_path / "sitecustomize.py").write_text(BLOCKED)
    source = "synthetic:frames=2&views=2&width=16&height=12&supersample=1"
    settings = {"first_frame__max_iterations": 3, "first_frame__max_points": 40}
    command = arguments(tmp_path / "o", source=source, stream__epochs=1, **settings)
    code, _, err = finish(*command, PYTHONPATH=str(tmp_path))
    assert code == 0, err
    assert err.count("warning: ") == err.count("\n") == 1, err
    assert "about 500 times slower" in err
    assert re.search(r"install a C\+\+20 compiler, then: \S.* install \S*/plugins/cpu_render", err)
    assert "no compiled module for this Python" in err
    assert [line["frame"] for line in metrics(tmp_path / "o")] == [0, 1]
    pictures = tmp_path / "pictures"
    code, _, err = finish("play", str(tmp_path / "o"), "--out", str(pictures), PYTHONPATH=str(tmp_path))
    assert code == 0
    assert err.count("warning: ") == err.count("\n") == 1, err
    assert "plain numpy: about 100 times slower" in err
    assert len(list(pictures.iterdir())) == 2


def test_make_says_that_a_compiler_is_missing(tmp_path: Path) -> None:
    """Before anything is downloaded. The environment is there already; only the compiler is not."""
    for name in ("Makefile", "requirements.txt", "pyproject.toml"):
        shutil.copy(ROOT / name, tmp_path / name)
    python = tmp_path / ".venv" / "bin" / "python"
    python.parent.mkdir(parents=True)
    python.write_text("#!/bin/sh\necho 'nothing may be installed' >&2\nexit 9\n")
    python.chmod(0o755)
    command = ["make", "setup", "CXX=/nowhere/c++"]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=600, check=False)
    assert result.returncode != 0
    assert "builds its renderer with a C++20 compiler; '/nowhere/c++' is missing or too old" in result.stdout
    assert "make CXX=clang++" in result.stdout
    assert "nothing may be installed" not in result.stderr


@pytest.fixture
def plugins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str, str], None]:
    """Install a plugin, given as text, for this process."""

    def install(name: str, text: str) -> None:
        folder = tmp_path / "site"
        write_metadata(folder, f"gsstream-{name}", "0.7", f"[gsstream]\n{name} = gsstream_{name}\n")
        (folder / f"gsstream_{name}.py").write_text(text)
        monkeypatch.syspath_prepend(str(folder))

    return install


def test_a_source_of_a_plugin_is_opened_and_its_faults_are_its_own(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], plugins: Callable[[str, str], None]
) -> None:
    text = textwrap.dedent(f"""
        from gsstream.spec import ComponentSpec, hookimpl

        @hookimpl
        def gsstream_components():
            target = "gsstream_mine:open_mine"
            return [ComponentSpec(kind="source", name="mine", target=target, summary="the analytic scene again")]

        def open_mine(uri, scale):
            from gsstream.input.recordings.open import open_source

            if uri == "mine:bad":
                raise RuntimeError("the cable is loose")
            return open_source({WORLD!r}, scale)
    """)
    plugins("mine", text)
    encode(tmp_path / "o", "--frames", "2", source="mine:here")
    assert len(metrics(tmp_path / "o")) == 2
    err = refused(capsys, arguments(tmp_path / "p", source="mine:bad"), code=1)
    assert "source 'mine' (from gsstream-mine 0.7) could not open 'mine:bad': the cable is loose" in err
    assert json.loads((tmp_path / "o" / "metrics.jsonl").read_text().splitlines()[0])["psnr"]
