"""Where pictures are taken from and written to: orbits, paths from files, sizes, file types, renderers by name."""

from __future__ import annotations

import importlib.metadata
import json

import numpy as np
import pytest
from PIL import Image
from test_player import ARC, NUMPY, look_at, make_stream

from gsstream.cli.main import run_command
from gsstream.core.errors import InputError, OutputError, PluginUnavailable, UnknownName
from gsstream.core.world import World
from gsstream.player.camera_file import read_path
from gsstream.player.export import export
from gsstream.player.paths import camera_path, resized
from gsstream.player.play import play
from gsstream.player.region import MIN_SWING
from gsstream.player.render import named_renderer

OUT_OF_ARC = 1e-6


def azimuths(cameras) -> np.ndarray:
    return np.arctan2(cameras.centers[:, 1], cameras.centers[:, 0])


@pytest.mark.parametrize("first", [0, 3, 7])
@pytest.mark.parametrize("turn", [0.0, 2.0, 3.1])
def test_an_orbit_stays_where_cameras_are(first, turn) -> None:
    angles = turn + np.linspace(-0.6, 0.6, 8)
    order = [first, *(i for i in range(8) if i != first)]
    rig = look_at([(3 * np.cos(a), 3 * np.sin(a), 1.0) for a in angles]).select(order)
    path = camera_path("orbit", rig, 40)
    off = (azimuths(path) - turn + np.pi) % (2 * np.pi) - np.pi
    assert np.abs(off).max() <= 0.6 + OUT_OF_ARC
    assert off.min() < -0.55, "both ends are visited"
    assert off.max() > 0.55
    # The point it turns around is drawn a little towards the cameras, here by a tenth of a thousandth of its distance.
    assert path.centers[0] == pytest.approx(rig.centers[0], abs=1e-3), "it begins at the first camera"
    assert np.abs(np.diff(off, append=off[0])).max() < 0.12, "no jump, also from the last picture to the first"


def test_an_orbit_of_a_ring_is_a_full_turn() -> None:
    rig = look_at([(3 * np.cos(a), 3 * np.sin(a), 1.0) for a in np.linspace(0, 2 * np.pi, 8, endpoint=False)])
    steps = np.diff(np.unwrap(azimuths(camera_path("orbit", rig, 40))))
    assert np.abs(steps) == pytest.approx(np.full(39, 2 * np.pi / 40), abs=1e-6)


def test_an_orbit_of_one_camera_swings_a_little() -> None:
    path = camera_path("orbit", look_at([(3.0, 0, 1)]), 16)
    spread = np.ptp(np.unwrap(np.arctan2(*(path.centers - path.centers.mean(0))[:, :2].T)))
    assert np.linalg.norm(path.centers - path.centers[0], axis=1).max() > 0
    assert np.isfinite(spread)
    assert MIN_SWING < 0.2


@pytest.mark.parametrize("size", [(142, 90), (200, 45), (30, 90), (1, 1)])
def test_another_size_keeps_the_vertical_field_of_view(size) -> None:
    rig = look_at(ARC)
    other = resized(rig, *size)
    other.validate()
    assert (other.width, other.height) == size
    top, bottom = ((v - rig.Ks[0, 1, 2]) / rig.Ks[0, 1, 1] for v in (0, rig.height))
    assert [(v - other.Ks[0, 1, 2]) / other.Ks[0, 1, 1] for v in (0, size[1])] == pytest.approx([top, bottom])
    assert other.Ks[0, 0, 0] / other.Ks[0, 1, 1] == pytest.approx(rig.Ks[0, 0, 0] / rig.Ks[0, 1, 1]), "not stretched"
    assert (other.Ks[0, 0, 2] - size[0] / 2) * rig.height == pytest.approx((rig.Ks[0, 0, 2] - 35.5) * size[1])


def write_path(tmp_path, rig, **more) -> str:
    file = tmp_path / "path.json"
    file.write_text(json.dumps({"cameras": [{"w2c": pose.tolist()} for pose in rig.viewmats], **more}))
    return str(file)


def test_a_path_from_a_file_shows_its_cameras(tmp_path) -> None:
    stream, rig = make_stream(tmp_path / "s.gss"), look_at([*ARC, (0.0, 3.0, 2.0)])
    played = play(stream, tmp_path / "a", camera=write_path(tmp_path, rig), renderer=NUMPY)
    assert played.frames == 5
    play(stream, tmp_path / "b", camera="cam1", renderer=NUMPY)
    pictures = [(tmp_path / folder / "000001.png").read_bytes() for folder in "ab"]
    assert pictures[0] == pictures[1], "the second pose is that of cam1"


def test_a_path_from_a_file_is_in_the_recordings_coordinates(tmp_path) -> None:
    world = World((0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0), (5e5, 5.2e6, 300.0), 40.0)
    stream, rig = make_stream(tmp_path / "s.gss", world=world), look_at(ARC)
    file = write_path(tmp_path, world.cameras(rig).select([1]))
    for out, camera in (("a", file), ("b", "cam1")):
        play(stream, tmp_path / out, camera=camera, frames=[0], renderer=NUMPY)
    pictures = [np.asarray(Image.open(tmp_path / out / "000000.png"), np.int16) for out in "ab"]
    assert pictures[0].std() > 10
    assert np.abs(pictures[0] - pictures[1]).max() <= 1


def test_few_poses_are_run_between(tmp_path) -> None:
    from pathlib import Path

    rig = look_at(ARC[:2])
    path = read_path(Path(write_path(tmp_path, rig, width=142, height=90)), rig, 11)
    path.validate()
    assert (len(path), path.width, path.height) == (11, 142, 90)
    assert path.viewmats[[0, -1]] == pytest.approx(rig.viewmats, abs=1e-9)
    assert path.centers[5] == pytest.approx(rig.centers.mean(0))
    turned = np.einsum("tij,tkj->tik", path.viewmats[1:, :3, :3], path.viewmats[:-1, :3, :3])
    angles = np.arccos(np.clip((np.trace(turned, axis1=1, axis2=2) - 1) / 2, -1, 1))
    assert angles == pytest.approx(np.full(10, angles[0]), abs=1e-6), "the turn is even"
    half_turn = look_at([(3.0, 0, 0), (-3.0, 0, 0)])
    read_path(Path(write_path(tmp_path, half_turn)), half_turn, 7).validate()
    one = read_path(Path(write_path(tmp_path, rig.select([1]))), rig, 4)
    assert one.viewmats == pytest.approx(np.repeat(rig.viewmats[1:], 4, axis=0))


BAD_PATHS = {
    "no such file": None, "no JSON": "{", "no cameras": "{}", "empty": '{"cameras": []}', "list": "[1]",
    "no pose": '{"cameras": [{}]}', "ragged": '{"cameras": [{"w2c": [[1, 2], [3]]}]}',
    "mirrored": json.dumps({"cameras": [{"w2c": np.diag([-1.0, 1, 1, 1]).tolist()}]}),
    "NaN": '{"cameras": [{"w2c": [[NaN,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}]}',
    "size": json.dumps({"width": 0, "cameras": [{"w2c": np.eye(4).tolist()}]}),
    "K": json.dumps({"K": [[1]], "cameras": [{"w2c": np.eye(4).tolist()}]}),
}  # fmt: skip


@pytest.mark.parametrize("fault", BAD_PATHS)
def test_faulty_paths_are_refused_by_name(fault, tmp_path) -> None:
    file = tmp_path / "path.json"
    if BAD_PATHS[fault] is not None:
        file.write_text(BAD_PATHS[fault])
    with pytest.raises(InputError, match=r"path\.json"):
        read_path(file, look_at(ARC), 3)


@pytest.mark.parametrize("name", ["x.avi", "x.png", "x.MOV", "x.webm", "x.jpg"])
def test_file_types_that_are_not_written_are_refused(name, tmp_path, capsys) -> None:
    stream = make_stream(tmp_path / "s.gss")
    assert run_command(["play", str(stream), "--out", str(tmp_path / name)]) == 2
    assert ".mp4, .webp, .gif" in capsys.readouterr().err
    assert not (tmp_path / name).exists()


def test_pictures_do_not_go_among_the_results_of_a_run(tmp_path) -> None:
    stream = make_stream(tmp_path / "stream.gss")
    with pytest.raises(OutputError, match="folder of a run"):
        play(stream, tmp_path, renderer=NUMPY)
    assert [path.name for path in tmp_path.iterdir()] == ["stream.gss"]
    assert play(stream, tmp_path / "v1.2", renderer=NUMPY, frames=[0]).path.is_dir(), "a dot in a folder's name is fine"
    with pytest.raises(OutputError, match="expected a folder"):
        export(stream, tmp_path / "q.ply", "ply")


def test_size_and_renderer_of_the_command(tmp_path, capsys) -> None:
    stream = make_stream(tmp_path / "s.gss")
    arguments = ["play", str(stream), "--frames", "0:1", "--out", str(tmp_path / "p")]
    assert run_command([*arguments, "--size", "100x40", "--renderer", "numpy"]) == 0
    with Image.open(tmp_path / "p" / "000000.png") as image:
        assert image.size == (100, 40)
    for wrong in ("100", "0x5", "10x99999", "axb", "-1x5"):
        assert run_command([*arguments, f"--size={wrong}"]) == 2
        assert "expected WIDTHxHEIGHT" in capsys.readouterr().err
    assert run_command([*arguments, "--renderer", "nump"]) == 2
    assert "did you mean 'numpy'" in capsys.readouterr().err


def test_a_renderer_is_found_by_its_name(monkeypatch) -> None:
    points = [
        importlib.metadata.EntryPoint("a-first", "gsstream.player.software:render_numpy", "gsstream.player"),
        importlib.metadata.EntryPoint("mine", "gsstream.player.software:render_numpy", "gsstream.player"),
        importlib.metadata.EntryPoint("broken", "no_such_module:f", "gsstream.player"),
    ]
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda group: points)
    assert named_renderer("mine").name == "mine"
    assert named_renderer("numpy").name == "numpy"
    with pytest.raises(PluginUnavailable, match="no_such_module"):
        named_renderer("broken")
    with pytest.raises(UnknownName, match="did you mean 'mine'"):
        named_renderer("mina")
