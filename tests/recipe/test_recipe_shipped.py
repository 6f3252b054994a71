"""Recipes of recordings that gsstream ships: found by name, one file each, linked from ``configs``."""

from __future__ import annotations

from pathlib import Path

import pytest

from gsstream.cli.main import run_command
from gsstream.core.errors import RecipeError, UnknownName
from gsstream.input.recordings.detect import LAYOUTS
from gsstream.recipe.load import ResolvedRecipe, resolve_recipe
from gsstream.recipe.shipped import FOLDER, OF_LAYOUT, names, recipe_file

ROOT = Path(__file__).parents[2]
METHODS = ROOT / "gsstream" / "recipe" / "methods"


def find(name: str) -> Path:
    return METHODS / f"{name}.yaml"


def resolve(*files: str | Path) -> ResolvedRecipe:
    return resolve_recipe("dense", find, [Path(file) for file in files])


def test_the_folder_for_people_holds_links_so_that_nothing_can_drift() -> None:
    own = ROOT / "configs" / "recordings" / "at_hand.yaml"  # scenes of a sweep, no recipe
    links = {path for path in (ROOT / "configs" / "recordings").iterdir() if path != own}
    links.add(ROOT / "configs" / "live.yaml")
    assert all(path.is_symlink() for path in links)
    assert sorted(path.resolve() for path in links) == sorted((FOLDER / f"{name}.yaml").resolve() for name in names())
    assert all(path.name == path.resolve().name for path in links)


@pytest.mark.parametrize("name", names())
def test_a_name_is_the_file_and_provenance_says_the_name(name: str) -> None:
    found = resolve(f"recording:{name}")
    assert found.recipe == resolve(recipe_file(f"recording:{name}")).recipe
    labels = {origin.label for path, origin in found.origins.items() if path != ("method",)}
    assert f"recording {name}" in labels
    assert labels <= {f"recording {name}", "method dense"}, "a path of this machine is not in a recipe that is kept"


def test_a_file_may_be_based_on_one_and_a_later_one_wins(tmp_path: Path) -> None:
    mine = tmp_path / "mine.yaml"
    mine.write_text("base: recording:n3dv\nframes: 7\n", encoding="utf-8")
    recipe = resolve(mine, "recording:live").recipe
    assert (recipe.scale, recipe.frames, recipe.stream.refine_frames) == (0.5, 7, 10)


def test_every_layout_of_a_data_set_has_its_recipe() -> None:
    assert set(OF_LAYOUT) <= set(LAYOUTS)
    assert set(OF_LAYOUT.values()) <= set(names())


def test_a_misspelt_name_is_answered_with_the_nearest_and_the_list(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(
        UnknownName, match=r"no recipe of a recording named 'n3dw'; did you mean 'n3dv'\? All: campus, "
    ):
        resolve("recording:n3dw")
    with pytest.raises(UnknownName) as caught:
        resolve("recording:")
    assert str(caught.value).count("meetroom") == 1
    assert run_command(["recipe", "dense", "--recipe", "recording:live2"]) == 2
    assert "did you mean 'live'" in capsys.readouterr().err


def test_a_path_that_is_not_there_is_answered_with_the_name() -> None:
    """After ``pip install`` there is no folder ``configs``."""
    with pytest.raises(RecipeError, match="a recipe of this name comes with gsstream: --recipe recording:n3dv"):
        resolve("configs/recordings_elsewhere/n3dv.yaml")
    with pytest.raises(RecipeError) as caught:
        resolve("configs/mine.yaml")
    assert "recording:" not in str(caught.value)
