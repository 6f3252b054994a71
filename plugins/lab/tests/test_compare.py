"""Methods side by side: one frame 0 for all, equal passes, equal time, and a page of what really ran."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from gsstream_lab.commands.options import RecordingOptions, scene_name
from gsstream_lab.report.groups import SweepData, read_sweep_data
from gsstream_lab.report.pictures import Tile, tiles_in_rows
from gsstream_lab.sweep.compare import EPOCHS, equal_epochs, equal_time, own_epochs, own_settings
from gsstream_lab.sweep.config import SweepConfig
from gsstream_lab.sweep.plan import make_plan
from gsstream_lab.sweep.table import read_table
from PIL import Image

from gsstream.cli.main import run_command
from gsstream.core.errors import InputError, RecipeError
from gsstream.discovery.catalog import load_catalog
from gsstream.player.playback import Playback

SOURCE = "synthetic:frames=3&views=3&width=64&height=48&supersample=1"
SMALL = [
    item
    for value in ("max_iterations=5", "max_points=200", "points=recording")
    for item in ("--set", f"first_frame.{value}")
]
COMMAND = ["--source", SOURCE, "--frames", "2", *SMALL, "--workers", "1", "--quiet"]


@pytest.fixture(scope="module")
def compared(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, SweepData]:
    """A comparison at own settings, and what its table held then; one of the three methods fails."""
    out = tmp_path_factory.mktemp("compared")
    wrong = out / "wrong.yaml"
    wrong.write_text("base: dense\nupdate: {params: {means: {lr: 1.0e+30}}}\n")
    assert run_command(["compare", f"dense,hold,{wrong}", *COMMAND, "--out", str(out)]) == 1
    return out, read_sweep_data(out)


def test_all_methods_have_one_frame_0_and_are_on_the_page(compared) -> None:
    out, data = compared
    assert [group.variant for group in data.groups] == ["dense", "hold"]
    assert len(data.table.first_frames) == 1
    first = []
    for group in data.groups:
        with Playback(out / "cells" / f"{group.runs[0].id}.gss") as playback:
            first.append(playback.state_at(0).means)
    np.testing.assert_array_equal(np.sort(first[0], 0), np.sort(first[1], 0))
    page, html = (out / "report.md").read_text(), (out / "report.html").read_text()
    for group in data.groups:
        assert f"{group.runs[0].values['psnr_changed']:.2f}" in page
    assert "dense" in page
    assert html.count("<img") == page.count("![") == 4
    with Image.open(out / "video.webp") as video:
        assert video.n_frames == 2
    quality = data.groups[1].runs[0].records[1].psnr_changed
    assert quality, "what changed is measured, on the test camera"
    assert list(data.failed) == ["synthetic wrong seed 0"]
    assert "Runs that failed" in page


def test_the_same_command_goes_on_and_equal_time_uses_what_was_measured(compared) -> None:
    out, data = compared
    made = {path: path.stat().st_mtime_ns for path in (out / "cells").iterdir()}
    own_time = data.groups[0].mean("cpu_seconds")
    limit = own_time / 10
    at_time = ["--at", "time", "--seconds", f"{limit:.6f}"]
    assert run_command(["compare", "dense,hold", *COMMAND, *at_time, "--out", str(out)]) == 0
    assert {path: path.stat().st_mtime_ns for path in made} == made, "finished runs were kept"
    table = read_table(out)
    points = {point["variant"]: point["axes"] for point in table.plan["points"]}
    own_number = data.table.recipes[data.groups[0].runs[0].row["recipe"]]["values"]["stream"]["epochs"]
    assert points == {"dense": {EPOCHS: round(own_number / 10)}, "hold": {}}
    assert [row["status"] for row in table.cells.values()].count("done") == 3
    assert len(table.first_frames) == 1


def planned(*methods: str, seeds: Sequence[int] = (0,)) -> SweepConfig:
    return own_settings(methods, RecordingOptions("demo").scene(), seeds)


def test_equal_epochs_leaves_methods_alone_that_make_none() -> None:
    catalog, config = load_catalog(), planned("hold", "dense", seeds=(0, 1))
    assert own_epochs(config, catalog) == {"hold": None, "dense": 20}
    assert equal_epochs(config, [], catalog).variants[1].axes == {EPOCHS: [20]}, "those of the first that makes any"
    config = equal_epochs(config, [2, 5], catalog)
    plan = make_plan(config, Path(), catalog.recipe_path)
    assert [(cell.variant, cell.seed, cell.axes.get(EPOCHS)) for cell in plan.points] == [
        (name, seed, epochs) for seed in (0, 1) for name, epochs in (("hold", None), ("dense", 2), ("dense", 5))
    ]
    assert len(plan.firsts) == 2, "one for each seed, whatever the method"
    assert "no passes in hold" in config.description


@pytest.mark.parametrize(
    ("seconds", "epochs"),
    [([], [20]), ([1.0], [10]), ([1e-9, 1e-8], [1]), ([4.0, 1.0], [40, 10])],
    ids=["time of the first that makes passes", "half the time", "at least one pass", "a curve"],
)
def test_equal_time_gives_passes_in_proportion(seconds: list[float], epochs: list[int]) -> None:
    config = equal_time(planned("hold", "dense"), seconds, {"hold": 0.1, "dense": 2.0}, load_catalog())
    assert {variant.name: variant.axes for variant in config.variants} == {"hold": {}, "dense": {EPOCHS: epochs}}


def test_without_seconds_some_method_must_have_run() -> None:
    for methods, took in ((("hold",), {"hold": 0.1}), (("dense",), {})):
        with pytest.raises(InputError, match="no method that makes passes"):
            equal_time(planned(*methods), [], took, load_catalog())


def test_recipe_files_are_methods_and_names_are_used_once(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text("base: dense\nstream: {epochs: 3}\n")
    mine = str(tmp_path / "mine.yaml")
    assert own_epochs(planned(mine), load_catalog()) == {"mine": 3}
    with pytest.raises(RecipeError, match="two methods are called 'mine'"):
        planned(mine, mine)


@pytest.mark.parametrize(
    ("source", "name"),
    [
        ("demo", "demo"),
        ("n3dv:/data/flame_salmon/", "flame_salmon"),
        ("/data/pick blocks", "pick-blocks"),
        (SOURCE, "synthetic"),
        ("..", "recording"),
        ("../rec/k.1?missing=refuse", "k.1"),
        ("/", "recording"),
    ],
)
def test_recordings_are_called_by_their_last_part(source: str, name: str) -> None:
    assert scene_name(source) == name


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--epochs", "3"], "--epochs 3 belongs to --at epochs"),
        (["--at", "epochs", "--epochs", "3,0"], "expected different whole numbers from 1 on"),
        (["--at", "time", "--seconds", "nan"], "expected different numbers"),
        (["--seeds", "1,1"], "expected different whole numbers from 0 on"),
    ],
)
def test_wrong_numbers_are_refused_before_anything_runs(tmp_path, capsys, options: list[str], said: str) -> None:
    assert run_command(["compare", "dense,hold", *COMMAND, *options, "--out", str(tmp_path / "out")]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_tiles_stand_where_they_belong() -> None:
    rng = np.random.default_rng(0)
    images = [rng.random((5, 7, 3)).astype(np.float32) for _ in range(3)]
    sheet = tiles_in_rows([[Tile("a", images[0]), Tile("b", images[1])], [Tile("c", images[2])]])
    height = 5 + 30 + 4
    assert sheet.shape == (2 * height, 2 * (7 + 4), 3)
    for image, (top, left) in zip(images, ((30, 0), (30, 11), (height + 30, 0)), strict=True):
        np.testing.assert_array_equal(sheet[top : top + 5, left : left + 7], np.rint(image * 255).astype(np.uint8))
