"""Sequences and pictures of methods trained elsewhere, and recordings that streams of others name."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_player import ARC, look_at

from gsstream.cli.main import run_command
from gsstream.core.changes import Layout
from gsstream.core.errors import InputError
from gsstream.evaluation.offline import bytes_line, numbered
from gsstream.packet import KeyState, StreamMeta, StreamWriter, encode_key
from gsstream.player.ply import ply_bytes, read_ply
from tests.scenes import make_scene

SOURCE = "synthetic:frames=3&views=3&width=64&height=48&supersample=1"
SMALL = ("max_iterations=5", "max_points=200")


@pytest.fixture(scope="module")
def stream(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("run") / "run"
    command = ["run", "--method", "dense", "--source", SOURCE, "--out", str(out), "--quiet", "--no-pictures"]
    sets = [item for value in (*SMALL, "sh_degree=1") for item in ("--set", f"first_frame.{value}")]
    assert run_command([*command, *sets, "--set", "stream.epochs=1"]) == 0
    return out


def evaluated(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict:
    capsys.readouterr()
    assert run_command(["evaluate", *map(str, arguments), "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_an_exported_sequence_is_as_good_as_its_stream(stream: Path, tmp_path: Path, capsys) -> None:
    """The files are in the recording's coordinates: there and back costs no more than float32 does."""
    out = tmp_path / "sequence"
    assert run_command(["export", str(stream), "--format", "sequence", "--out", str(out)]) == 0
    own = evaluated(capsys, stream)
    theirs = evaluated(capsys, "--ply-sequence", out, "--source", SOURCE)
    assert theirs["sigmas"] == own["sigmas"]
    assert len(theirs["views"]) == len(own["views"]) > 0
    for view, expected in zip(theirs["views"], own["views"], strict=True):
        assert (view["frame"], view["camera"]) == (expected["frame"], expected["camera"])
        for name in ("psnr", "ssim", "psnr_moving", "psnr_changed"):
            assert view[name] == (None if expected[name] is None else pytest.approx(expected[name], abs=2e-3)), name
    assert run_command(["evaluate", "--ply-sequence", str(out), "--source", SOURCE, "--frames", "0:2"]) == 0
    size = sum((out / f"{frame:06d}.ply").stat().st_size for frame in (0, 1)) / 1000
    assert f"2 files, {size:.1f} KB; {size / 2:.1f} KB/frame over 2 frames" in capsys.readouterr().out


def test_positions_relative_to_an_offset_are_put_back(stream: Path, tmp_path: Path, capsys) -> None:
    for origin in ("recording", "local"):
        command = ["export", str(stream), "--format", "ply", "--out", str(tmp_path / origin), "--origin", origin]
        assert run_command(command) == 0
    there, local = (
        evaluated(capsys, "--ply-sequence", tmp_path / name, "--source", SOURCE) for name in ("recording", "local")
    )
    assert [v["psnr"] for v in local["views"]] == pytest.approx([v["psnr"] for v in there["views"]], abs=2e-3)


def test_pictures_count_like_the_stream_that_drew_them(stream: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "pictures"
    assert run_command(["play", str(stream), "--camera", "test", "--out", str(out)]) == 0
    own, theirs = evaluated(capsys, stream), evaluated(capsys, "--renders", out, "--source", SOURCE)
    psnr = [[view["psnr"] for view in found["views"]] for found in (own, theirs)]
    # The pictures have eight bits: errors of 1/255 at most, on top of ten times as large ones.
    assert psnr[1] == pytest.approx(psnr[0], abs=0.1)
    assert theirs["renderer"] == "elsewhere"
    shifted = tmp_path / "from-one"
    shifted.mkdir()
    for path in out.rglob("*.png"):
        path.rename(shifted / f"view_{int(path.stem) + 1}.png")
    again = evaluated(capsys, "--renders", shifted, "--source", SOURCE, "--first", 1)
    assert again["views"] == theirs["views"]
    Image.new("RGB", (63, 48)).save(shifted / "view_2.png")
    assert run_command(["evaluate", "--renders", str(shifted), "--source", SOURCE, "--first", "1"]) == 2
    assert "expected 64 x 48 pixels as the recording has at this --scale, got 63 x 48" in capsys.readouterr().err


@pytest.mark.parametrize(("number", "rest"), [(7, 0), (7, 3), (7, 8), (7, 15), (0, 3), (1, 0)])
def test_a_ply_is_read_as_it_was_written(tmp_path: Path, number: int, rest: int) -> None:
    written, path = make_scene(number, rest + 1), tmp_path / "a.ply"
    path.write_bytes(ply_bytes(written, ["offset 1.5 -2 1e6"]))
    read, offset = read_ply(path)
    assert offset == (1.5, -2.0, 1e6)
    for (name, value), (_, expected) in zip(read.items(), written.items(), strict=True):
        assert value.tobytes() == expected.tobytes(), name


def test_properties_in_another_order_and_of_other_types_are_read(tmp_path: Path) -> None:
    """As other programs write them: a property more, doubles, and no normals."""
    written = make_scene(3, 1)
    columns = {
        "red": np.zeros(3, np.uint8),
        "opacity": written.opacities.astype("<f8"),
        **{f"rot_{i}": written.quats[:, i] for i in range(4)},
        **{f"scale_{i}": written.scales[:, i] for i in range(3)},
        **{f"f_dc_{i}": written.sh0[:, 0, i] for i in range(3)},
        **{name: written.means[:, i] for i, name in enumerate("zyx")},
    }
    kinds = {"|u1": "uchar", "<f8": "double", "<f4": "float"}
    head = ["ply", "format binary_little_endian 1.0", "element vertex 3"]
    head += [f"property {kinds[value.dtype.str]} {name}" for name, value in columns.items()]
    table = np.zeros(3, [(name, value.dtype) for name, value in columns.items()])
    for name, value in columns.items():
        table[name] = value
    (tmp_path / "a.ply").write_bytes("\n".join([*head, "end_header\n"]).encode() + table.tobytes())
    read, offset = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(read.means, written.means[:, ::-1])
    np.testing.assert_array_equal(read.opacities, written.opacities)
    assert offset == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda data: b"solid x", "expected a PLY with the line"),
        (lambda data: data[:-1], "bytes of vertices"),
        (lambda data: data.replace(b"float opacity", b"float opaque!"), "missing opacity"),
        (lambda data: data.replace(b"vertex 7", b"vertex x"), "header is not that of a 3DGS PLY"),
        (lambda data: data.replace(b"vertex 7", b"vertex -1"), "header is not that of a 3DGS PLY"),
        (lambda data: data.replace(b"property float x", b"property list x"), "header is not that of a 3DGS PLY"),
        (lambda data: data.replace(b"property float y", b"property float x"), "each property once"),
    ],
)
def test_files_that_are_no_such_ply_are_refused(tmp_path: Path, change, said: str) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(change(ply_bytes(make_scene(7, 1))))
    with pytest.raises(InputError, match=said):
        read_ply(path)


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


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "expected one of STREAM"),
        (["a.gss", "--renders", "b"], "expected one of STREAM"),
        (["--renders", "b"], "name it with --source"),
        (["a.gss", "--first", "1"], "belong to --ply-sequence and --renders"),
    ],
)
def test_options_that_would_do_nothing_are_refused(capsys, arguments: list[str], said: str) -> None:
    assert run_command(["evaluate", *arguments]) == 2
    assert said in capsys.readouterr().err


def hostile_stream(path, **changes):
    rig, scene = look_at(ARC), make_scene(5)
    meta = StreamMeta("dense", "test", {}, rig.select([0, 1, 2]), rig.select([3]), 25.0)
    layout = Layout(np.ones(5, np.int32), np.zeros(5, np.uint8), np.float32([1]))
    with StreamWriter.open(path) as writer:
        writer.append(encode_key(KeyState(scene, layout, dataclasses.replace(meta, **changes))))
    return path


def test_a_stream_whose_recipe_is_empty_is_compared_like_others(tmp_path, capsys) -> None:
    path = hostile_stream(tmp_path / "s.gss")
    assert run_command(["evaluate", str(path), "--source", SOURCE]) == 2
    assert "the recording does not fit the stream" in capsys.readouterr().err


@pytest.mark.parametrize(
    "uri", ["watch:DIR?timeout=86400", "disturbed:gain=2:watch:DIR", "watch:", "disturbed::watch:x"]
)
def test_a_stream_cannot_make_it_wait(uri, tmp_path, capsys) -> None:
    path = hostile_stream(tmp_path / "s.gss", extra={"source_uri": uri.replace("DIR", str(tmp_path))})
    assert run_command(["evaluate", str(path)]) == 2
    assert "name it yourself with --source" in capsys.readouterr().err


RECIPES = {
    "scale": [{"scale": value} for value in ("x", None, 0, -1, 2, True, [1])],
    "seed": [{"seed": value} for value in ([], "7", None, 1.5)],
}


@pytest.mark.parametrize("key", RECIPES)
def test_recipes_that_no_run_can_have_had_are_refused(key, tmp_path, capsys) -> None:
    for i, recipe in enumerate(RECIPES[key]):
        path = hostile_stream(tmp_path / f"{i}.gss", recipe=recipe, extra={"source_uri": "demo"})
        assert run_command(["evaluate", str(path)]) == 2
        assert f"its recipe says {key} = " in capsys.readouterr().err


@pytest.mark.parametrize("uri", ["x" * 5000, "folder:" + "y" * 5000, "\0", "a\nb\x1b[2J"])
def test_names_that_are_no_files_are_refused_in_one_line(uri, tmp_path, capsys) -> None:
    path = hostile_stream(tmp_path / "s.gss", extra={"source_uri": uri})
    assert run_command(["evaluate", str(path)]) == 2
    err = capsys.readouterr().err
    assert err.startswith("error: ")
    assert "\x1b" not in err
