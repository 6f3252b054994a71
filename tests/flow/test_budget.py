"""Budgets on real runs, tiny: sizes hold in the file, what cannot be held is said."""

from __future__ import annotations

from pathlib import Path

import pytest
from flow_runs import arguments, demo_copy, encode, metrics

from gsstream.cli.main import run_command
from gsstream.engine.budget import plan
from gsstream.packet import StreamReader
from gsstream.player.playback import Playback

SIZE = 500
TIGHT = ("--budget", f"size={SIZE}B")


@pytest.fixture(scope="module")
def held(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three frames of the demo recording at half size, in a size that binds."""
    folder = tmp_path_factory.mktemp("held")
    demo_copy(folder / "scene", frames=4)
    encode(folder / "out", *TIGHT, "--scale", "0.5", source=str(folder / "scene"), method="s2gs-edge")
    return folder


def later_sizes(out: Path) -> list[int]:
    with StreamReader(out / "stream.gss") as reader:
        return [entry.size for entry in reader.frames][1:]


def test_sizes_hold_in_the_file_and_are_reported(held: Path) -> None:
    encode(held / "free", "--scale", "0.5", source=str(held / "scene"), method="s2gs-edge")
    assert max(later_sizes(held / "free")) > 1.5 * SIZE, "a size that binds"
    sizes, lines = later_sizes(held / "out"), metrics(held / "out")
    assert max(sizes) <= SIZE
    assert [sum(line["bytes"].values()) for line in lines[1:]] == sizes
    for line in lines[1:]:
        entry = line["budget"]
        assert entry["limits"] == {"size": SIZE}
        assert entry["violated"] == []
        assert entry["binding"] == ["size"]
        assert {"symbols", "rd_lambda"} & set(entry["reduced"])
        assert entry["usage"]["untrimmed_bytes"] >= sum(line["bytes"].values())
    summary = (held / "out" / "summary.txt").read_text()
    assert f"budget size {SIZE / 1000:.2f} KB: 3 of 3 frames inside" in summary
    assert "\ngiven up: " in summary
    assert "time: 1.0" not in (held / "out" / "recipe.yaml").read_text()
    assert f"size: {SIZE}" in (held / "out" / "recipe.yaml").read_text()


def test_a_time_that_cannot_be_held_is_said_frame_by_frame(tmp_path: Path) -> None:
    """A millisecond is gone before the first view: one view is made, and every frame says that it is late."""
    encode(tmp_path, "--budget", "time=1ms", method="s2gs-edge", stream__epochs=2)
    lines = metrics(tmp_path)
    assert [line["budget"]["violated"] for line in lines] == [[], *[["time"]] * 5]
    assert all(line["iterations"] == 1 for line in lines[1:] if line["status"] == "delta")
    assert all(line["budget"]["actual"]["time"] > 1e-3 for line in lines[1:])
    summary = (tmp_path / "summary.txt").read_text()
    assert "budget time 0.00 s: 0 of 5 frames inside" in summary
    assert summary.count("  frame ") == 5
    with Playback(tmp_path / "stream.gss") as playback:
        assert list(playback.frames) == list(range(6))


def test_plenty_of_time_makes_the_most_passes(tmp_path: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plan, "MOST_EPOCHS", 4)
        encode(tmp_path, "--budget", "time=5min", "--frames", "3", method="s2gs-edge", stream__epochs=2)
    assert [line["iterations"] for line in metrics(tmp_path)[1:]] == [12, 12]
    encode(tmp_path / "p", "--budget", "time=5min", "--frames", "2", method="dense", stream__epochs=31)
    assert metrics(tmp_path / "p")[1]["iterations"] == 31 * 3, "the recipe's own number is never the limit"


def test_key_packets_wait_for_a_budget_that_has_room(tmp_path: Path) -> None:
    encode(tmp_path / "small", *TIGHT, method="s2gs-edge", codec__key_interval=2)
    lines = metrics(tmp_path / "small")
    assert [line["status"] for line in lines[1:]].count("key") == 0
    assert ["key_postponed" in line for line in lines] == [False, False, True, True, True, True]
    assert f"bytes where {SIZE} are allowed" in lines[2]["key_postponed"]
    assert (
        "a key packet was due and postponed in 4 frames (frames 2 to 5): period: about"
        in (tmp_path / "small" / "summary.txt").read_text()
    )
    encode(tmp_path / "large", "--budget", "size=1MB", method="s2gs-edge", codec__key_interval=2)
    assert [line["status"] for line in metrics(tmp_path / "large")][2::2] == ["key", "key"]


def test_memory_limits_frame_0_or_refuses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = arguments(tmp_path / "no", "--budget", "memory=100MB")
    assert run_command(command) == 2
    err = capsys.readouterr().err
    assert "budget.memory: 100 MB, but a run of this recording needs at least 31" in err
    assert "give more, or lower --scale" in err
    assert not (tmp_path / "no" / "stream.gss").exists()
    encode(tmp_path / "yes", "--budget", "memory=316MB", "--frames", "2")
    recipe = metrics(tmp_path / "yes"), (tmp_path / "yes" / "recipe.yaml").read_text()
    assert all("memory" in line["budget"]["limits"] for line in recipe[0])
    with Playback(tmp_path / "yes" / "stream.gss") as playback:
        limits = playback.meta.recipe["first_frame"]["max_gaussians"]
    assert 1000 <= limits < 2000
    assert all(0 < line["num_gaussians"] <= limits for line in recipe[0]), "also the seeds, not only what grows"


def test_seeds_are_limited_as_well_as_growth(tmp_path: Path) -> None:
    """A structure places several anchors for a point; a recording once began with half as many again as allowed."""
    encode(tmp_path, "--frames", "2", method="s2gs-edge", first_frame__max_gaussians=90)
    assert all(0 < line["num_gaussians"] <= 90 for line in metrics(tmp_path))
