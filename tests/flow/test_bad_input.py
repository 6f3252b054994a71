"""What a user can give wrong: one clear message on stderr, a non-zero exit, and nothing already written is lost."""

from __future__ import annotations

import json
import math
import re
import shutil
import subprocess
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flow_runs import WORLD, arguments, demo_copy, encode, finish, metrics
from PIL import Image

from gsstream.cli.main import run_command
from gsstream.packet import StreamReader

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


def camera(data: dict[str, Any], **values: Any) -> None:
    data["cameras"][1].update(values)


def poison(data: dict[str, Any]) -> None:
    data["cameras"][1]["w2c"][0][3] = math.nan


CALIBRATIONS: dict[str, tuple[Callable[[dict[str, Any]], None], list[str]]] = {
    "camera without frames": (
        lambda d: camera(d, frames="nowhere/%06d.jpg"),
        ["camera 'cam01' has no frames; expected ", "nowhere/000000.jpg"],
    ),
    "camera without a pattern": (lambda d: camera(d, frames=None), ["camera 'cam01' has no frames; give \"frames\""]),
    "no inverse": (
        lambda d: camera(d, K=[[0, 0, 80], [0, 150, 60], [0, 0, 1]]),
        ["cameras.json", "camera 'cam01' are not invertible"],
    ),
    "NaN pose": (poison, ["cameras.json", "pose ", "camera 'cam01'", "nan"]),
    "sizes differ": (lambda d: camera(d, width=80), ["'cam00' is 160 x 120 and 'cam01' is 80 x 120"]),
}


@pytest.mark.parametrize("fault", CALIBRATIONS)
def test_faulty_calibrations(tmp_path: Path, capsys: pytest.CaptureFixture[str], fault: str) -> None:
    edit, words = CALIBRATIONS[fault]
    folder = demo_copy(tmp_path / "r", edit=edit)
    err = refused(capsys, arguments(tmp_path / "o", source=str(folder)))
    for word in words:
        assert word in err
    assert not (tmp_path / "o").exists(), "a recording that cannot be read leaves no folder behind"


def test_a_missing_image_is_noticed_before_anything_is_trained(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = demo_copy(tmp_path / "r")
    lost = folder / "cam01" / "000002.jpg"
    lost.unlink()
    err = refused(capsys, arguments(tmp_path / "o", source=str(folder)))
    assert f"camera 'cam01': 1 of 3 frames are missing, the first is {lost}" in err
    assert not (tmp_path / "o").exists()


def truncated(path: Path) -> str:
    path.write_bytes(path.read_bytes()[:700])
    return "the image cannot be decoded"


def smaller(path: Path) -> str:
    Image.fromarray(np.zeros((60, 80, 3), np.uint8)).save(path)
    return "the image is 80 x 60 pixels, but cameras.json declares 160 x 120"


@pytest.mark.parametrize("spoil", [truncated, smaller])
def test_a_bad_image_later_on_costs_only_what_comes_after_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], spoil: Callable[[Path], str]
) -> None:
    folder, out = demo_copy(tmp_path / "r"), tmp_path / "o"
    image = folder / "cam01" / "000002.jpg"
    good = image.read_bytes()
    message = spoil(image)
    command = arguments(out, source=str(folder), scale=0.4)
    err = refused(capsys, command)
    assert str(image) in err
    assert message in err
    with StreamReader(out / "stream.gss") as reader:
        assert [entry.frame for entry in reader.frames] == [0, 1]
    image.write_bytes(good)
    assert run_command([*command, "--resume"]) == 0
    assert [line["frame"] for line in metrics(out)] == [0, 1, 2]
    assert (out / "stream.gss").read_bytes() == encode(tmp_path / "u", source=str(folder), scale=0.4)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (["--method", "s2gs-egde"], "no method named 's2gs-egde'; did you mean 's2gs-edge'?"),
        (["--set", "gate=gumbel-sigmoit"], "gate.name: no gate named 'gumbel-sigmoit'; did you mean 'gumbel-sigmoid'?"),
        (["--set", "stream.epoch=3"], "unknown key 'stream.epoch'; did you mean 'epochs'?"),
        (
            ["--method", "s2gs", "--set", "gate.temperatur=1"],
            "unknown key 'gate.params.temperatur'; did you mean 'temperature'?",
        ),
        (["--source", "dmo"], "source 'dmo': no such folder and no known scheme; expected 'demo'"),
        (["--source", "synthetic:frame=3"], "unknown option 'frame'; did you mean 'frames'?"),
        (["--set", "renderer=cpuu"], "no renderer named 'cpuu'; did you mean 'cpu'?"),
        (["--first-frame", "absent.gss"], "no stream at absent.gss: expected a .gss file or the output folder"),
    ],
    ids=lambda value: value if isinstance(value, str) else None,
)
def test_names_that_do_not_exist(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], changes: list[str], words: str
) -> None:
    assert words in refused(capsys, [*arguments(tmp_path / "o"), *changes])


def test_an_unknown_key_in_a_file_is_named_with_its_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recipe = tmp_path / "mine.yaml"
    recipe.write_text("stream:\n  epochs: 3\nfirst_frame:\n  sh_degre: 1\n")
    err = refused(capsys, arguments(tmp_path / "o", "--recipe", str(recipe)))
    assert "mine.yaml:4" in err
    assert "unknown key 'first_frame.sh_degre'; did you mean 'sh_degree'?" in err


def test_a_folder_with_another_run_is_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    encode(tmp_path, "--frames", "1")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    err = refused(capsys, arguments(tmp_path))
    assert "already holds a run (stream.gss, metrics.jsonl, recipe.yaml)" in err
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


FAILING = textwrap.dedent("""
    from typing import final
    import torch
    from gsstream.api import ConfidenceEstimator
    from gsstream.spec import ComponentSpec, hookimpl

    @hookimpl
    def gsstream_components():
        target = "gsstream_failing:Failing"
        return [ComponentSpec(kind="confidence", name="failing", target=target, summary="breaks in frame 3")]

    @final
    class Failing(ConfidenceEstimator):
        def estimate(self, context):
            if context.index == 3:
                raise ZeroDivisionError("of my own making")
            return torch.zeros(len(context.gaussians))
""")


@pytest.fixture
def plugins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str, str], None]:
    """Install a plugin, given as text, for this process."""

    def install(name: str, text: str) -> None:
        folder = tmp_path / "site"
        (info := folder / f"gsstream_{name}-0.7.dist-info").mkdir(parents=True)
        (folder / f"gsstream_{name}.py").write_text(text)
        (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: gsstream-{name}\nVersion: 0.7\n")
        (info / "entry_points.txt").write_text(f"[gsstream]\n{name} = gsstream_{name}\n")
        monkeypatch.syspath_prepend(str(folder))

    return install


def test_a_part_that_fails_is_named_and_costs_one_frame(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], plugins: Callable[[str, str], None]
) -> None:
    plugins("failing", FAILING)
    out = tmp_path / "o"
    err = refused(capsys, arguments(out, confidence="failing"), code=1)
    assert err.startswith(
        "confidence 'Failing' (from gsstream-failing) failed at frame 3: ZeroDivisionError: of my own making"
    )
    assert "complete up to frame 2" in err
    with StreamReader(out / "stream.gss") as reader:
        reader.check()
        assert [entry.frame for entry in reader.frames] == [0, 1, 2]
        assert reader.unfinished is None
    assert run_command(["--debug", *arguments(out, "--resume", confidence="failing")]) == 1
    assert "raise ZeroDivisionError" in capsys.readouterr().err, "--debug shows where"


def test_a_plugin_that_cannot_be_imported_stops_only_who_asks_for_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], plugins: Callable[[str, str], None]
) -> None:
    plugins("lost", "import a_module_that_nobody_has\n")
    err = refused(capsys, arguments(tmp_path / "o", method="lost"), code=1)
    assert "method 'lost' is not available: plugin 'lost' (from gsstream-lost 0.7) is in quarantine" in err
    assert "No module named 'a_module_that_nobody_has'" in err
    encode(tmp_path / "o", "--frames", "1")
    assert run_command(["methods"]) == 0
    out, err = capsys.readouterr()
    assert "s2gs-edge" in out
    assert "warning: plugin 'lost' (gsstream-lost) is in quarantine" in err


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
