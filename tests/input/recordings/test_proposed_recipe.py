"""A recording in the layout of a published data set: ``run`` names the recipe of that data set, and applies nothing."""

from __future__ import annotations

from pathlib import Path

import pytest
from tiny_recordings import LAYOUTS, make_world, write_nerfstudio, write_panoptic

from gsstream.cli.main import run_command
from gsstream.cli.run import meant_for
from gsstream.recipe.load import load_recipe
from gsstream.recipe.model import Recipe
from gsstream.recipe.shipped import OF_LAYOUT


@pytest.mark.parametrize("name", LAYOUTS)
def test_the_layout_names_the_recipe(name: str, tmp_path: Path) -> None:
    folder = LAYOUTS[name].write(tmp_path / "r", make_world())
    kind = LAYOUTS[name].scheme
    assert meant_for(f"{kind}:{folder}") == OF_LAYOUT.get(kind)
    assert meant_for(str(folder)) == OF_LAYOUT.get(kind)


@pytest.mark.parametrize("uri", ["demo", "synthetic:frames=2", "watch:capture", "disturbed:gain=2:demo", "n4dv:x"])
def test_other_sources_have_none(uri: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert meant_for(uri) is None
    (tmp_path / uri).mkdir()  # a folder that has the name of a source by chance is not what is meant
    monkeypatch.chdir(tmp_path)
    assert uri == "n4dv:x" or meant_for(uri) is None


def test_a_run_says_so_in_one_line_and_applies_nothing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = write_panoptic(tmp_path / "r", make_world())
    line = "note: this recording has the layout of a published data set: --recipe recording:panoptic sets its split"
    command = ["run", "--method", "hold", "--no-pictures", "--overwrite", "--frames", "1", "--out", str(tmp_path / "o")]
    command += ["--set", "first_frame.max_iterations=2", "--source", str(folder)]
    assert run_command(command) == 0
    assert capsys.readouterr().err.count(line) == 1
    done = load_recipe(tmp_path / "o" / "recipe.yaml").recipe
    assert (done.data, done.near, done.first_frame.exposure) == (Recipe().data, Recipe().near, False)
    own = [*command, "--recipe", "recording:panoptic", "--set", "data.test_cameras=[]"]
    assert run_command(own) == 0
    assert "published data set" not in capsys.readouterr().err
    assert run_command([*command, "--quiet"]) == 0
    assert "published data set" not in capsys.readouterr().err


def test_nothing_is_said_of_a_layout_that_any_recording_may_have(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = write_nerfstudio(tmp_path / "r", make_world())
    command = ["run", "--method", "hold", "--no-pictures", "--frames", "1", "--out", str(tmp_path / "o")]
    assert run_command([*command, "--set", "first_frame.max_iterations=2", "--source", str(folder)]) == 0
    assert "published data set" not in capsys.readouterr().err
