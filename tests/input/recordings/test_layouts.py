"""Every layout: its own way to project, its pictures, its split, and a run on it from end to end."""

from __future__ import annotations

import importlib.util
import json
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from tiny_recordings import LAYOUTS, World, make_world, tracks, world_points, write_colmap, write_n3dv, write_ply

from gsstream.cli.main import run_command
from gsstream.core.cameras import Cameras
from gsstream.core.errors import SourceError
from gsstream.input.recordings.open import open_source
from gsstream.input.recordings.options import DataOptions
from gsstream.input.recordings.recorded import RecordedSource
from gsstream.input.recordings.transformed import transformed
from gsstream.player.playback import Playback


@pytest.fixture(scope="module")
def world() -> World:
    return make_world()


def pixels(rig: Cameras, camera: str, points: np.ndarray) -> np.ndarray:
    """Our convention, written out: u = K (R X + t) / z."""
    i = rig.ids.index(camera)
    inside = points @ rig.viewmats[i, :3, :3].T + rig.viewmats[i, :3, 3]
    image = inside @ rig.Ks[i].T
    return image[:, :2] / image[:, 2:]


@pytest.mark.parametrize("name", LAYOUTS)
def test_cameras_pictures_split_and_points(tmp_path: Path, world: World, name: str) -> None:
    layout = LAYOUTS[name]
    folder = layout.write(tmp_path / "scene", world)
    source = open_source(str(folder))
    info = source.info
    assert (info.num_frames, info.fps) == (3, pytest.approx(layout.fps))
    assert info.test.ids == layout.test
    names = [layout.names(c) for c in range(4)]
    assert sorted((*info.train.ids, *info.test.ids)) == sorted(names)
    points = world_points(world)
    for c, camera in enumerate(names):
        rig = info.test if camera in info.test.ids else info.train
        ours = pixels(rig, camera, points)
        np.testing.assert_allclose(ours, layout.project(folder, c, points), atol=1e-6)
        truth = Cameras((camera,), world.poses[[c]], world.Ks[[c]], 48, 32)
        np.testing.assert_allclose(ours, pixels(truth, camera, points), atol=1e-6)
        for t in (2, 0, 1):
            frame = source.frame(t, "test" if camera in info.test.ids else "train")
            seen = np.round(frame.images[frame.cameras.ids.index(camera)] * 255)
            np.testing.assert_array_equal(seen, world.pictures[t, c])
    assert (source.points() is not None) == layout.has_points
    named = open_source(f"{layout.scheme}:{folder}")
    assert named.info.train.ids == info.train.ids
    source.close()
    source.frame(0).validate()  # closing releases files; reading opens them again


def test_scaled_reading_scales_the_cameras(tmp_path: Path, world: World) -> None:
    folder = LAYOUTS["enerf"].write(tmp_path / "scene", world)
    full, half = open_source(str(folder)), open_source(str(folder), 0.5)
    np.testing.assert_allclose(half.info.train.Ks[:, :2] * 2, full.info.train.Ks[:, :2])
    assert [source.frame(1).timestamp for source in (full, half)] == [1 / full.info.fps] * 2
    assert full.info.fps > 1
    blocks = full.frame(1).images.reshape(3, 16, 2, 24, 2, 3).mean((2, 4))
    np.testing.assert_allclose(half.frame(1).images, blocks, atol=1e-6)


@pytest.mark.parametrize("binary", [True, False])
def test_points_with_the_test_camera_in_their_track_are_held_back(tmp_path: Path, world: World, binary: bool) -> None:
    source = open_source(str(write_colmap(tmp_path / "scene", world, binary=binary, frames="images")))
    everything = source.points()
    assert everything is not None
    np.testing.assert_allclose(everything.xyz, world.xyz, atol=1e-6)
    np.testing.assert_array_equal(np.round(everything.rgb * 255), world.rgb)
    clean = transformed(source, DataOptions(test_cameras=("cam00",))).points()
    assert clean is not None
    rows = [p for p, track in enumerate(tracks(world)) if 0 not in track]
    assert 0 < len(rows) < len(world.xyz)
    np.testing.assert_array_equal(clean.xyz, everything.xyz[rows])
    leaked = transformed(source, DataOptions(test_cameras=("cam00",), leak="points")).points()
    assert leaked is not None
    assert len(leaked) == len(everything)


def test_points_made_from_all_views_need_a_leak(tmp_path: Path, world: World) -> None:
    folder = write_n3dv(tmp_path / "scene", world, style="images")
    write_ply(folder / "points3D_downsample2.ply", world.xyz, world.rgb)
    source = open_source(str(folder))
    assert source.points() is None
    leaked = transformed(source, DataOptions(leak="points")).points()
    assert leaked is not None
    np.testing.assert_allclose(leaked.xyz, world.xyz, atol=1e-6)
    assert transformed(source, DataOptions(test_cameras=())).points() is not None  # no test cameras: nothing leaks


@pytest.mark.sfm
@pytest.mark.skipif(importlib.util.find_spec("pycolmap") is None, reason="pycolmap is not installed")
@pytest.mark.parametrize("extension", ["bin", "txt"])
def test_models_written_by_pycolmap_are_read_as_pycolmap_reads_them(
    tmp_path: Path, world: World, extension: str
) -> None:
    """pycolmap loads our hand-written model, writes it in its own way, and projects: three independent paths."""
    folder = write_colmap(tmp_path / "scene", world, frames="images")
    sparse = folder / "sparse" / "0"
    code = (
        "import zlib, sys, numpy as np, pycolmap\n"
        "sparse, points, out, kind = sys.argv[1:]\n"
        "r = pycolmap.Reconstruction(sparse)\n"
        "p = np.load(points)\n"
        "at = {i.name: [i.project_point(x) for x in p] for i in r.images.values()}\n"
        "np.savez(out, **at)\n"
        "r.write_binary(sparse) if kind == 'bin' else r.write_text(sparse)\n"
    )
    points = world_points(world)
    np.save(tmp_path / "points.npy", points)
    files = [str(sparse), str(tmp_path / "points.npy"), str(tmp_path / "at.npz")]
    command = [sys.executable, "-c", code, *files, extension]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr
    for old in sparse.glob("*.bin"):
        if extension == "txt":
            old.unlink()
    source = open_source(str(folder))
    with np.load(tmp_path / "at.npz") as theirs:
        for camera in source.info.train.ids:
            np.testing.assert_allclose(pixels(source.info.train, camera, points), theirs[f"{camera}.png"], atol=1e-6)
    cloud = source.points()
    assert cloud is not None
    # pycolmap keeps points in no order.
    order, theirs = np.lexsort(cloud.xyz.T), np.lexsort(world.xyz.T)
    np.testing.assert_allclose(cloud.xyz[order], world.xyz[theirs], atol=1e-6)


def test_meet_room_counts_its_cameras(tmp_path: Path) -> None:
    """With ten cameras or more the order of names matters: rows of poses_bounds.npy follow the numbers."""
    world = make_world(views=12, frames=1)
    folder = LAYOUTS["meetroom"].write(tmp_path / "scene", world)
    source = open_source(str(folder))
    assert source.info.train.ids == tuple(f"cam_{c}" for c in range(1, 12))
    np.testing.assert_allclose(source.info.train.viewmats, world.poses[1:], atol=1e-9)


def test_no_layout_and_several_layouts_are_told_apart(tmp_path: Path, world: World) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(
        SourceError, match=r"no known layout\. Expected .*folder: cameras\.json; n3dv: cam00.*scene prepare"
    ):
        open_source(str(tmp_path / "empty"))
    folder = write_colmap(tmp_path / "both", world, frames="folders")
    other = LAYOUTS["nerfstudio"].write(tmp_path / "other", world)
    shutil.copy(other / "transforms.json", folder)
    with pytest.raises(SourceError, match=r"fit several layouts: colmap .*; nerfstudio .*Say which: --source colmap:"):
        open_source(str(folder))
    assert isinstance(open_source(f"colmap:{folder}"), RecordedSource)
    with pytest.raises(SourceError, match=r"no such folder; expected transforms\.json"):
        open_source(f"nerfstudio:{tmp_path / 'absent'}")


TINY = {
    "first_frame.max_iterations": 12,
    "first_frame.max_points": 300,
    "stream.epochs": 1,
}


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
        assert playback.meta.extra["source_uri"] == folder.name
    assert (out / "recording.txt").read_text() == f"{folder}\n"
