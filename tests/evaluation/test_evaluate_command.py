"""``gsstream evaluate`` on streams that name recordings and recipes as no run of ours does."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from test_player import ARC, look_at

from gsstream.cli.main import run_command
from gsstream.core.changes import Layout
from gsstream.input.recordings.origin import public_uri
from gsstream.packet import KeyState, StreamMeta, StreamWriter, encode_key
from tests.scenes import make_scene

SOURCE = "synthetic:frames=3&views=3&width=64&height=48&supersample=1"


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


WAITING = ["watch:DIR?timeout=86400", "disturbed:gain=2:watch:DIR", "watch:", "disturbed::watch:x"]
FETCHED = ["s3://bucket/take", "folder:https://127.0.0.1:1/take", "http://127.0.0.1:1/take"]


@pytest.mark.parametrize("uri", WAITING + FETCHED)
def test_a_file_of_a_run_cannot_make_it_wait_or_ask_the_network(uri, tmp_path, capsys) -> None:
    path = hostile_stream(tmp_path / "stream.gss", extra={"source_uri": uri})
    (tmp_path / "recording.txt").write_text(uri.replace("DIR", str(tmp_path)))
    assert run_command(["evaluate", str(path)]) == 2
    assert "name it yourself with --source" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["evaluate", "left-behind"])
@pytest.mark.parametrize("said", ["a-folder", "folder:a-folder", "disturbed:", "", "/whole/path/of/before"])
def test_a_stream_alone_does_not_say_where_its_recording_lies(command, said, tmp_path, capsys) -> None:
    path = hostile_stream(tmp_path / "s.gss", extra={"source_uri": said})
    (tmp_path / "recording.txt").write_text("/whole/path/of/before\n")  # of another stream: this one is not stream.gss
    assert run_command([command, str(path)]) == 2
    err = capsys.readouterr().err
    assert f"was made from the recording {said!r} and does not say where that lies" in err
    assert "name it with --source" in err


def test_a_run_s_folder_that_names_another_recording_is_refused(tmp_path, capsys) -> None:
    path = hostile_stream(tmp_path / "stream.gss", extra={"source_uri": "mine"})
    (tmp_path / "recording.txt").write_text("/data/yours\n")
    assert run_command(["evaluate", str(path)]) == 2
    assert "recording.txt beside it names '/data/yours'; name the right one" in capsys.readouterr().err


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
    path = hostile_stream(tmp_path / "stream.gss", extra={"source_uri": public_uri(uri)})
    (tmp_path / "recording.txt").write_text(uri)
    assert run_command(["evaluate", str(path)]) == 2
    err = capsys.readouterr().err
    assert err.startswith("error: ")
    assert "\x1b" not in err
