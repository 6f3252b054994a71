"""Every layout, end to end: three frames through ``gsstream run``, and the stream says where it comes from."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from scenes import LAYOUTS, World, make_world

from gsstream.cli.main import run_command
from gsstream.player.playback import Playback

TINY = {
    "first_frame.max_iterations": 12, "first_frame.max_points": 300,
    "stream.epochs": 1,
}  # fmt: skip


@pytest.fixture(scope="module")
def world() -> World:
    return make_world()


@pytest.mark.parametrize("name", ["n3dv", "meetroom", "enerf", "panoptic", "colmap text", "nerfstudio timed"])
def test_three_frames(tmp_path: Path, world: World, name: str) -> None:
    layout = LAYOUTS[name]
    folder = layout.write(tmp_path / "scene", world)
    settings = [item for key, value in TINY.items() for item in ("--set", f"{key}={value}")]
    if not layout.test:
        settings += ["--set", f'data.test_cameras=["{layout.names(0)}"]']
    out = tmp_path / "out"
    command = ["run", "--source", str(folder), "--method", "s2gs-edge", "--out", str(out), "--quiet", "--no-pictures"]
    assert run_command([*command, *settings]) == 0
    lines = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    assert [line["frame"] for line in lines] == [0, 1, 2]
    assert all(list(line["psnr"]) == [layout.names(0)] for line in lines)
    with Playback(out / "stream.gss") as playback:
        assert playback.meta.test.ids == (layout.names(0),)
        assert len(playback.meta.train.ids) == 3
        assert playback.meta.extra["source_uri"] == str(folder)
