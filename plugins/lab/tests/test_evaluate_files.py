"""Sequences and pictures of methods that were trained elsewhere, measured like a stream."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from gsstream_lab.files import bytes_line, numbered
from PIL import Image

from gsstream.cli.main import run_command
from gsstream.core.errors import InputError

SOURCE = "synthetic:frames=3&views=3&width=64&height=48&supersample=1"
SMALL = ("max_iterations=5", "max_points=200", "points=recording")


@pytest.fixture(scope="module")
def stream(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("run") / "run"
    command = ["run", "--method", "dense", "--source", SOURCE, "--out", str(out), "--quiet", "--no-pictures"]
    sets = [item for value in (*SMALL, "sh_degree=1") for item in ("--set", f"first_frame.{value}")]
    assert run_command([*command, *sets, "--set", "stream.epochs=1"]) == 0
    return out


def printed(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict:
    capsys.readouterr()
    assert run_command([*map(str, arguments), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def measured(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict:
    return printed(capsys, "evaluate-files", "--source", SOURCE, *arguments)


def test_an_exported_sequence_is_as_good_as_its_stream(stream: Path, tmp_path: Path, capsys) -> None:
    """The files are in the recording's coordinates: there and back costs no more than float32 does."""
    out = tmp_path / "sequence"
    assert run_command(["export", str(stream), "--format", "sequence", "--out", str(out)]) == 0
    own = printed(capsys, "evaluate", stream)
    theirs = measured(capsys, "--ply-sequence", out)
    assert theirs["sigmas"] == own["sigmas"]
    assert len(theirs["views"]) == len(own["views"]) > 0
    for view, expected in zip(theirs["views"], own["views"], strict=True):
        assert (view["frame"], view["camera"]) == (expected["frame"], expected["camera"])
        for name in ("psnr", "ssim", "psnr_moving", "psnr_changed"):
            assert view[name] == (None if expected[name] is None else pytest.approx(expected[name], abs=2e-3)), name
    assert run_command(["evaluate-files", "--ply-sequence", str(out), "--source", SOURCE, "--frames", "0:2"]) == 0
    size = sum((out / f"{frame:06d}.ply").stat().st_size for frame in (0, 1)) / 1000
    assert f"2 files, {size:.1f} KB; {size / 2:.1f} KB/frame over 2 frames" in capsys.readouterr().out


def test_positions_relative_to_an_offset_are_put_back(stream: Path, tmp_path: Path, capsys) -> None:
    for origin in ("recording", "local"):
        command = ["export", str(stream), "--format", "ply", "--out", str(tmp_path / origin), "--origin", origin]
        assert run_command(command) == 0
    there, local = (measured(capsys, "--ply-sequence", tmp_path / name) for name in ("recording", "local"))
    assert [v["psnr"] for v in local["views"]] == pytest.approx([v["psnr"] for v in there["views"]], abs=2e-3)


def test_pictures_count_like_the_stream_that_drew_them(stream: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "pictures"
    assert run_command(["play", str(stream), "--camera", "test", "--out", str(out)]) == 0
    own, theirs = printed(capsys, "evaluate", stream), measured(capsys, "--renders", out)
    psnr = [[view["psnr"] for view in found["views"]] for found in (own, theirs)]
    # The pictures have eight bits: errors of 1/255 at most, on top of ten times as large ones.
    assert psnr[1] == pytest.approx(psnr[0], abs=0.1)
    assert theirs["renderer"] == "elsewhere"
    shifted = tmp_path / "from-one"
    shifted.mkdir()
    for path in out.rglob("*.png"):
        path.rename(shifted / f"view_{int(path.stem) + 1}.png")
    again = measured(capsys, "--renders", shifted, "--first", 1)
    assert again["views"] == theirs["views"]
    Image.new("RGB", (63, 48)).save(shifted / "view_2.png")
    assert run_command(["evaluate-files", "--renders", str(shifted), "--source", SOURCE, "--first", "1"]) == 2
    assert "expected 64 x 48 pixels as the recording has at this --scale, got 63 x 48" in capsys.readouterr().err


def test_names_say_which_frame_a_file_is(tmp_path: Path) -> None:
    for name in ("time_00012.ply", "take2_3.ply", "notes.txt"):
        (tmp_path / name).touch()
    assert {frame: path.name for frame, path in numbered(tmp_path, (".ply",), 2).items()} == {
        1: "take2_3.ply",
        10: "time_00012.ply",
    }
    with pytest.raises(InputError, match="a number from 5 on"):
        numbered(tmp_path, (".ply",), 5)
    (tmp_path / "b_12.ply").touch()
    with pytest.raises(InputError, match="both frame 12"):
        numbered(tmp_path, (".ply",), 0)
    with pytest.raises(InputError, match=r"holds no file that ends with \.png"):
        numbered(tmp_path, (".png",), 0)
    with pytest.raises(InputError, match="is no folder"):
        numbered(tmp_path / "none", (".ply",), 0)


def test_bytes_of_folders_count_all_that_is_in_them(tmp_path: Path) -> None:
    (tmp_path / "model" / "deep").mkdir(parents=True)
    (tmp_path / "model" / "a").write_bytes(b"x" * 1500)
    (tmp_path / "model" / "deep" / "b").write_bytes(b"x" * 500)
    assert bytes_line([tmp_path / "model"], 4) == "2 files, 2.0 KB; 0.5 KB/frame over 4 frames"
    assert bytes_line([], 4) == ""
    with pytest.raises(InputError, match="no such file"):
        bytes_line([tmp_path / "none"], 1)


@pytest.mark.parametrize("given", [[], ["--ply-sequence", "a", "--renders", "b"]])
def test_one_of_sequence_and_pictures_is_measured(capsys, given: list[str]) -> None:
    assert run_command(["evaluate-files", "--source", SOURCE, *given]) == 2
    assert "expected one of --ply-sequence DIR and --renders DIR" in capsys.readouterr().err


def test_the_recipe_of_a_recording_is_named(capsys, tmp_path: Path) -> None:
    """The name is looked up, and what the recipe says is asked for: this recording has no camera cam00."""
    (tmp_path / "0.png").touch()
    command = ["evaluate-files", "--renders", str(tmp_path), "--source", SOURCE, "--recipe"]
    assert run_command([*command, "recording:n3dw"]) == 2
    assert "did you mean 'n3dv'" in capsys.readouterr().err
    assert run_command([*command, "recording:enerf_outdoor"]) == 2
    assert "data.test_cameras" in capsys.readouterr().err


def test_hidden_twins_of_a_mac_are_no_frames(tmp_path: Path) -> None:
    for name in ("000000.ply", "000001.ply", "._000000.ply", "._000001.ply"):
        (tmp_path / name).touch()
    assert [path.name for path in numbered(tmp_path, (".ply",), 0).values()] == ["000000.ply", "000001.ply"]
