"""Anchor insertion: what enters the scene is born, plays, resumes, and helps."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from flow_runs import Witness, arguments, demo_copy, encode, metrics
from gsstream_s2gs.anchor_insertion import place
from PIL import Image, ImageDraw

from gsstream.api import Gaussians, Layout
from gsstream.cli.main import run_command
from gsstream.packet import StreamReader
from gsstream.player.playback import Playback

#: A red ball that hangs over the table from frame 1 on, where frame 0 has nothing but air.
RADIUS = 0.06


def with_a_ball(folder: Path) -> Path:
    """The demo recording at its own size, six training cameras, three frames, and a ball drawn into the later two."""
    demo_copy(folder, train=6, frames=3)
    data = json.loads((folder / "cameras.json").read_text())
    points = np.load(folder / "points_frame0.npz")["xyz"]
    center = np.median(points, 0) + np.array([0, 0, 0.25])
    for camera in data["cameras"]:
        pose, K = np.array(camera["w2c"]), np.array(camera["K"])
        x, y, z = pose[:3, :3] @ center + pose[:3, 3]
        u, v, r = K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2], K[0, 0] * RADIUS / z
        for frame in (1, 2):
            path = folder / (camera["frames"] % frame)
            image = Image.open(path).convert("RGB")
            ImageDraw.Draw(image).ellipse((u - r, v - r, u + r, v + r), fill=(230, 20, 20))
            image.save(path, quality=95)
    return folder


SETS = {
    "stream__change_threshold": 6.0, "first_frame__max_iterations": 150, "stream__epochs": 3,
    "first_frame__max_points": 3000,
}  # fmt: skip


BORN = {"growth": "anchor-insertion", "growth__per_frame": 64, "growth__least_views": 3}


def test_a_ball_out_of_nowhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = str(with_a_ball(tmp_path / "recording"))
    encode(tmp_path / "fixed", source=source, method="s2gs-edge", **SETS)
    witness = Witness(monkeypatch)
    same_start = ("--first-frame", str(tmp_path / "fixed"))
    once = encode(tmp_path / "born", *same_start, source=source, method="s2gs-edge", **BORN, **SETS)
    fixed, born = metrics(tmp_path / "fixed"), metrics(tmp_path / "born")
    assert [line["births"] for line in fixed[1:]] == [0, 0]
    assert 1 <= born[1]["births"] <= 64
    assert born[1]["num_gaussians"] == born[0]["num_gaussians"] + born[1]["births"]
    moving = [[next(iter(line["psnr_moving"].values())) for line in run[1:]] for run in (fixed, born)]
    assert moving[1][0] > moving[0][0] + 0.2
    # (The arm moves too, and the ball covers a tenth of what counts as moving.) The player has what the encoder has.
    with Playback(tmp_path / "born" / "stream.gss") as playback:
        for frame, state in enumerate(witness.states):
            for (_, ours), (_, theirs) in zip(
                state.player.gaussians.items(), playback.player_state(frame).gaussians.items(), strict=True
            ):
                assert ours.tobytes() == theirs.tobytes()
    stream = tmp_path / "born" / "stream.gss"
    with StreamReader(stream) as reader:
        last = reader.frames[2]
    with stream.open("r+b") as file:
        file.truncate(last.offset + 3)
    again = encode(tmp_path / "born", "--resume", *same_start, source=source, method="s2gs-edge", **BORN, **SETS)
    assert again == once


def test_nothing_is_born_where_nothing_changes(tmp_path: Path) -> None:
    source = "synthetic:frames=2&views=3&width=48&height=32&supersample=1&motion=0"
    # Without an active set, so that the frames are really optimised.
    sets = {"stream__change_threshold": 0.0, **BORN}
    assert run_command(arguments(tmp_path, source=source, method="s2gs-edge", **sets)) == 0
    assert [line["births"] for line in metrics(tmp_path)[1:]] == [0]


def test_newborn_join_the_group_beside_them_or_found_one() -> None:
    layout = Layout(np.array([2, 1], np.int32), np.zeros(3, np.uint8), np.array([1.0, 0.5], np.float32))
    means = np.array([[0, 0, 0], [0.1, 0, 0], [5, 0, 0]], np.float32)
    where = np.array([[5.4, 0, 0], [20, 0, 0], [0.2, 0, 0], [30, 0, 0]], np.float32)
    rows = {name: np.zeros((4, *shape), np.float32) for name, shape in
            {"quats": (4,), "scales": (3,), "opacities": (), "sh0": (1, 3), "shN": (0, 3)}.items()}  # fmt: skip
    births = place(Gaussians(means=where, **rows), means, layout)
    assert births.nodes.tolist() == [0, 1, 2, 3]
    assert births.parents.tolist() == [2, 3]
    assert births.unit_of.tolist() == [1, 1, 1, 1]
    assert births.gaussians.means[:, 0].tolist() == pytest.approx([0.2, 5.4, 20, 30])
