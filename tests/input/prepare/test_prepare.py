"""From raw pictures to a scene: known poses, unknown poses, lenses, and input that cannot work."""

from __future__ import annotations

import importlib.util
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsstream.cli.main import run_command
from gsstream.core.errors import InputError, SourceError
from gsstream.input.prepare.prepare import PrepareOptions, prepare
from gsstream.input.prepare.raw import find_cameras
from gsstream.input.recordings.lens import from_colmap, undistortion
from gsstream.input.recordings.open import DEMO_FOLDER, open_source
from tests.input.prepare.bad_scenes import save
from tests.input.recordings.tiny_recordings import write_video

MAIN = "from gsstream.cli.main import main; main()"
needs_pycolmap = pytest.mark.skipif(importlib.util.find_spec("pycolmap") is None, reason="pycolmap is not installed")
#: Structure from motion needs neighbours that are not far apart, and pixels.
LARGE = "synthetic:width=320&height=240&views=10&frames=1&static=true"
FEW = LARGE.replace("views=10", "views=6")
WORLD = "synthetic:width=240&height=180&views=6&frames=2&supersample=1&motion=4"


def raw_pictures(folder: Path, frames: int = 2, world: str = WORLD) -> Path:
    """A folder of pictures per camera; the test camera of the world is called "test"."""
    source = open_source(world)
    for split in ("train", "test"):
        for t in range(frames):
            frame = source.frame(t, split)
            for name, image in zip(frame.cameras.ids, frame.images, strict=True):
                (folder / name).mkdir(parents=True, exist_ok=True)
                save(folder / name / f"shot{t}.png", image)
    return folder


def quiet(_: str) -> None:
    pass


@pytest.mark.sfm
@needs_pycolmap
def test_unknown_poses_are_recovered_and_the_test_camera_changes_nothing(tmp_path: Path) -> None:
    raw = raw_pictures(tmp_path / "raw", 1, LARGE)
    command = ["scene", "prepare", str(raw), "--out", str(tmp_path / "scene"), "--lens", "pinhole", "--quiet"]
    assert run_command([*command, "--test", "test"]) == 0
    scene, truth = open_source(str(tmp_path / "scene")).info, open_source(LARGE).info
    assert scene.train.ids == truth.train.ids
    assert scene.test.ids == ("test",)

    # Up to a similarity: distances of the centres keep their ratios, the test camera's included.
    def gaps(info):
        centers = np.concatenate([info.train.centers, info.test.centers])
        every = np.linalg.norm(centers[:, None] - centers[None], axis=2)
        return every / every.max()

    assert np.abs(gaps(scene) - gaps(truth)).max() < 0.02
    report = (tmp_path / "scene" / "report.md").read_text()
    assert "11 of 11 placed, 1 of them for testing only; recovered poses" in report
    assert (tmp_path / "scene" / "scene.png").stat().st_size > 5000
    for path in (raw / "test").iterdir():
        save(path, np.full((240, 320, 3), 0.5))
    made = prepare(raw, tmp_path / "blind", PrepareOptions(test=("test",), model="PINHOLE", frames=1), quiet)
    assert made.left_out == ("test",)
    assert made.rig.viewmats.tobytes() == scene.train.viewmats.tobytes()


@pytest.mark.sfm
@needs_pycolmap
def test_known_poses_are_kept_and_points_triangulated(tmp_path: Path) -> None:
    raw, rig = raw_pictures(tmp_path / "raw"), open_source(WORLD).info
    declared(raw)
    made = prepare(raw, tmp_path / "scene", PrepareOptions(), quiet)
    scene = open_source(str(tmp_path / "scene"))
    assert scene.info.fps == 25
    assert scene.info.test.ids == ("test",)
    assert np.array_equal(scene.info.train.viewmats, rig.train.viewmats)
    assert np.array_equal(scene.frame(1).images, open_source(WORLD).frame(1).images), "a pinhole's pictures are copied"
    points = scene.points()
    assert points is not None
    assert len(points) == len(made.points) > 50
    assert ((points.xyz >= made.bounds[0]) & (points.xyz <= made.bounds[1])).all()
    assert np.nanmax(made.mapping.camera_error) < 1
    made = prepare(raw, tmp_path / "small", PrepareOptions(frames=1, width=80), quiet)
    assert made.frames == 1
    scaled = rig.train.scaled(80, 60)
    assert np.allclose(open_source(str(tmp_path / "small")).info.train.Ks, scaled.Ks, rtol=1e-6)
    blocks = open_source(str(tmp_path / "scene")).frame(0).images.reshape(-1, 60, 3, 80, 3, 3).mean((2, 4))
    small = open_source(str(tmp_path / "small")).frame(0).images
    assert np.abs(small - blocks).max() < 1 / 255, "shrunk pictures are means: no raw pixel is skipped"


@pytest.mark.parametrize("model", ["OPENCV", "OPENCV_FISHEYE"])
def test_undistorted_pixels_come_from_where_the_lens_shows_them(model: str) -> None:
    params = (90.0, 95.0, 62.0, 47.0, -0.12, 0.02, 0.003, -0.002)
    K, lens = from_colmap(model, params, "here")
    made = undistortion(lens, K, (120, 90), target=(120, 90), where="here")
    x = (np.arange(120) + 0.5 - made.K[0, 2]) / made.K[0, 0]
    y = (np.arange(90) + 0.5 - made.K[1, 2]) / made.K[1, 1]
    x, y = np.meshgrid(x, y)
    k1, k2, p1, p2 = params[4:]
    r2 = x**2 + y**2
    if model == "OPENCV":  # Brown's model, as in the documentation of OpenCV
        radial = 1 + k1 * r2 + k2 * r2**2
        u, v = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2), y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    else:  # Kannala and Brandt: the four coefficients belong to powers of the angle
        r = np.sqrt(r2)
        angle = np.arctan(r)
        bent = angle * (1 + k1 * angle**2 + k2 * angle**4 + p1 * angle**6 + p2 * angle**8) / r
        u, v = x * bent, y * bent
    expected = np.stack([90 * u + 62, 95 * v + 47], axis=-1)
    assert np.abs(made.places - expected).max() < 1e-5, "float32"
    assert (made.places >= 0).all()
    assert (made.places <= (120, 90)).all()
    ramp = np.stack(np.meshgrid(np.arange(120) + 0.5, np.arange(90) + 0.5), axis=-1) / 120
    image = np.concatenate([ramp, ramp[..., :1]], axis=-1).astype(np.float32)
    inner = (slice(2, -2), slice(2, -2), slice(2))
    assert np.abs(made.apply(image)[inner] - made.places[2:-2, 2:-2] / 120).max() < 1e-4


LENS_TABLE: dict[str, dict[str, Any]] = {
    "one radial": {"distortion": [-0.1, 0.0, 0.0, 0.0]},
    "brown": {"distortion": [-0.12, 0.03, 0.001, -0.0005]},
    "pincushion": {"distortion": [0.08, -0.02, 0.0, 0.0]},
    "three radial": {"distortion": [-0.1, 0.02, 0.0, 0.001, 0.01]},
    "rational": {"distortion": [-0.2, 0.05, 0.003, -0.002, 0.01, 0.02, -0.01, 0.003]},
    "fisheye": {"distortion": [0.02, -0.005, 0.0, 0.0], "fisheye": True},
}


@pytest.mark.sfm
@needs_pycolmap
@pytest.mark.parametrize("lens", LENS_TABLE)
def test_a_lens_that_is_read_and_one_that_is_prepared_give_one_pinhole_and_its_pictures(
    tmp_path: Path, lens: str
) -> None:
    """Over lens models: equal intrinsics and equal bytes."""
    folder = tmp_path / "raw"
    shutil.copytree(DEMO_FOLDER, folder)
    data = json.loads((folder / "cameras.json").read_text())
    for camera in data["cameras"]:
        camera |= LENS_TABLE[lens]
    (folder / "cameras.json").write_text(json.dumps(data))
    prepare(folder, tmp_path / "made", PrepareOptions(frames=1), quiet)
    read, made = open_source(str(folder)), open_source(str(tmp_path / "made"))
    assert read.info.train.Ks[0, 0, 0] != open_source("demo").info.train.Ks[0, 0, 0]
    for split in ("train", "test"):
        assert np.allclose(getattr(read.info, split).Ks, getattr(made.info, split).Ks, rtol=1e-12)
        assert np.array_equal(read.stored_frame(0, split).images, made.stored_frame(0, split).images)


def raw_videos(folder: Path, frames: int, world: str) -> dict[str, list[np.ndarray]]:
    """A video without loss per camera; its frames as they were written, 8 bit."""
    pytest.importorskip("av")
    source, shown = open_source(world), {}
    for split in ("train", "test"):
        played = [source.frame(t, split) for t in range(frames)]
        for i, name in enumerate(played[0].cameras.ids):
            shown[name] = [np.round(frame.images[i] * 255).astype(np.uint8) for frame in played]
            write_video(folder / f"{name}.mkv", np.stack(shown[name]))
    return shown


def test_videos_are_raw_cameras(tmp_path: Path) -> None:
    shown = raw_videos(tmp_path / "raw", 2, WORLD)
    cameras, fps = find_cameras(tmp_path / "raw")
    assert fps == pytest.approx(30)
    assert [camera.name for camera in cameras] == sorted(shown)
    for camera in cameras:
        assert camera.size == (240, 180)
        frames = list(camera.frames(None))
        assert np.array_equal(np.round(np.stack(frames) * 255), shown[camera.name])
        assert len(list(camera.frames(1))) == 1
    path = tmp_path / "raw" / "cam01.mkv"
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(SourceError, match=r"cam01.mkv: the video (cannot be opened|holds no pictures)"):
        find_cameras(tmp_path / "raw")


@pytest.mark.sfm
@needs_pycolmap
def test_videos_without_poses_become_a_small_scene(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One of them goes on for longer than the others, which is said; the scene has the rate of the videos."""
    moving = LARGE.replace("frames=1&static=true", "frames=2&supersample=1")
    shown = raw_videos(tmp_path / "raw", 2, moving)
    write_video(tmp_path / "raw" / "cam04.mkv", np.stack([*shown["cam04"], shown["cam04"][0]]))
    command = ["scene", "prepare", str(tmp_path / "raw"), "--out", str(tmp_path / "scene"), "--lens", "pinhole"]
    assert run_command([*command, "--test", "test", "--width", "160", "--fps", "60"]) == 0
    said = capsys.readouterr()
    assert "differ in their frames (cam04 3 from 0); the 2 common ones are used" in said.err
    assert "the recording has 30 frames per second; --fps 60 is not used" in said.out
    scene = open_source(str(tmp_path / "scene"))
    assert (scene.info.num_frames, scene.info.train.width, scene.info.train.height) == (2, 160, 120)
    assert scene.info.fps == pytest.approx(30)
    blocks = np.stack([shown[name][1] for name in scene.info.train.ids]).reshape(-1, 120, 2, 160, 2, 3).mean((2, 4))
    assert np.abs(scene.frame(1).images * 255 - blocks).max() <= 1


@pytest.mark.sfm
@needs_pycolmap
def test_known_poses_without_features_become_a_scene_without_points(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Cameras that see nothing of each other, as those far apart; a run searches for points of its own."""
    raw, rng = raw_pictures(tmp_path / "raw", 1), np.random.default_rng(0)
    for path in raw.glob("*/*.png"):
        save(path, rng.random((180, 240, 3)))
    declared(raw, frames=1)
    assert run_command(["scene", "prepare", str(raw), "--out", str(tmp_path / "scene"), "--quiet"]) == 0
    assert "share too few features for points" in capsys.readouterr().err
    scene = open_source(str(tmp_path / "scene"))
    assert np.array_equal(scene.info.train.viewmats, open_source(WORLD).info.train.viewmats)
    assert scene.points() is None
    assert "bounds" not in (tmp_path / "scene" / "cameras.json").read_text()
    assert "points: none" in (tmp_path / "scene" / "report.md").read_text()


def test_what_cannot_be_prepared_is_said(tmp_path: Path) -> None:
    with pytest.raises(SourceError, match="no such folder"):
        find_cameras(tmp_path / "nowhere")
    (tmp_path / "raw").mkdir()
    save(tmp_path / "raw" / "only.png", np.zeros((8, 8, 3)))
    with pytest.raises(SourceError, match="expected at least two cameras"):
        find_cameras(tmp_path / "raw")
    save(tmp_path / "raw" / "other.png", np.zeros((8, 9, 3)))
    with pytest.raises(InputError, match=r"no two pictures share .*\(matches: only and other 0\); give poses instead"):
        prepare(tmp_path / "raw", tmp_path / "scene", PrepareOptions(), quiet)
    with pytest.raises(InputError, match="--test: no camera 'anything'"):
        prepare(tmp_path / "raw", tmp_path / "scene", PrepareOptions(test=("anything",)), quiet)
    with pytest.raises(InputError, match="not an empty folder"):
        prepare(tmp_path / "raw", tmp_path / "raw", PrepareOptions(), quiet)


def declared(raw: Path, world: str = WORLD, edit=lambda entry: None, frames: int = 2) -> None:
    """cameras.json of a world beside its raw pictures."""
    rig, cameras = open_source(world).info, []
    for split, part in (("train", rig.train), ("test", rig.test)):
        for name, K, w2c in zip(part.ids, part.Ks, part.viewmats, strict=True):
            entry = {
                "id": name,
                "split": split,
                "width": 240,
                "height": 180,
                "K": K.tolist(),
                "w2c": w2c.tolist(),
                "frames": f"{name}/shot%d.png",
            }
            edit(entry)
            cameras.append(entry)
    data = {"schema": "opencv-multiview-1", "name": "raw", "fps": 25, "frames": frames, "cameras": cameras}
    (raw / "cameras.json").write_text(json.dumps(data))


@pytest.mark.sfm
@needs_pycolmap
def test_cameras_of_other_sizes_are_brought_to_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A camera with twice the pixels and 20 more on either side must come out as the one that it was made from."""
    from PIL import Image

    raw, rig = raw_pictures(tmp_path / "raw"), open_source(WORLD).info
    odd = [rig.train.ids[1], rig.test.ids[0]]
    for name in odd:
        for path in (raw / name).iterdir():
            doubled = np.asarray(Image.open(path)).repeat(2, 0).repeat(2, 1)
            Image.fromarray(np.pad(doubled, ((0, 0), (20, 20), (0, 0)), mode="edge")).save(path)

    def larger(entry):
        if entry["id"] in odd:
            entry |= {"width": 520, "height": 360}
            entry["K"] = [[2 * v for v in row] for row in entry["K"][:2]] + [entry["K"][2]]
            entry["K"][0][2] += 20

    declared(raw, edit=larger)
    assert run_command(["run", "--source", str(raw), "--method", "hold", "--out", str(tmp_path / "run")]) == 2
    assert "gsstream scene prepare" in capsys.readouterr().err
    said = []
    prepare(raw, tmp_path / "scene", PrepareOptions(), said.append)
    assert any("minutes" in line for line in said), "what takes long is said before it begins"
    (line,) = [line for line in said if "all pictures become 240 x 180" in line]
    assert all(f"{name} 520 x 360" in line and f"--without {name}" not in line for name in odd)
    assert line.endswith(" ".join(f"--without {name}" for name in (*rig.train.ids, *rig.test.ids) if name not in odd))
    scene, world = open_source(str(tmp_path / "scene")), open_source(WORLD)
    assert np.allclose(scene.info.train.Ks, rig.train.Ks, rtol=1e-9)
    assert np.allclose(scene.info.test.Ks, rig.test.Ks, rtol=1e-9)
    for split in ("train", "test"):
        assert np.abs(scene.frame(1, split).images - world.frame(1, split).images).max() < 1.5 / 255


@pytest.mark.sfm
@needs_pycolmap
def test_unknown_cameras_of_other_sizes_are_placed(tmp_path: Path) -> None:
    from PIL import Image

    raw, truth = raw_pictures(tmp_path / "raw", 1, LARGE), open_source(LARGE).info
    name = truth.train.ids[3]
    for path in (raw / name).iterdir():
        image = Image.open(path)
        image.resize((480, 360), Image.Resampling.BICUBIC).save(path)
    made = prepare(raw, tmp_path / "scene", PrepareOptions(test=("test",), model="PINHOLE", frames=1), quiet)
    assert name not in made.left_out
    assert (made.rig.width, made.rig.height) == (320, 240)
    assert open_source(str(tmp_path / "scene")).frame(0).images.shape[1:] == (240, 320, 3)
    kept = [i for i, camera in enumerate(truth.train.ids) if camera in made.rig.ids]
    gaps, real = (
        np.linalg.norm(rig.centers[:, None] - rig.centers[None], axis=2)
        for rig in (made.rig.select([made.rig.ids.index(truth.train.ids[i]) for i in kept]), truth.train.select(kept))
    )
    assert np.abs(gaps / gaps.max() - real / real.max()).max() < 0.03


def photographs(folder: Path) -> Path:
    """A nerfstudio folder as tools write it: pictures named by digits, one of another size, a lens that distorts."""
    source = open_source(FEW)
    frame, entries = source.frame(0, "train"), []
    for number, (image, K, w2c) in enumerate(zip(frame.images, frame.cameras.Ks, frame.cameras.viewmats, strict=True)):
        image = image[:, : 320 - 16 * (number == 3)]
        folder.mkdir(exist_ok=True)
        save(folder / f"{number:04d}.png", image)
        pose = np.linalg.inv(w2c) @ np.diag([1.0, -1, -1, 1])
        entries.append(
            {
                "file_path": f"{number:04d}.png",
                "transform_matrix": pose.tolist(),
                "w": image.shape[1],
                "h": 240,
                "fl_x": K[0, 0],
                "fl_y": K[1, 1],
                "cx": K[0, 2],
                "cy": K[1, 2],
                "k1": 1e-3,
                "k3": 1e-3,
            }
        )
    (folder / "transforms.json").write_text(json.dumps({"frames": entries}))
    return folder


@pytest.mark.sfm
@needs_pycolmap
def test_photographs_become_a_picture_by_the_printed_commands_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    few = ["--no-video", "--out", "o", "--set", "first_frame.max_iterations=10", "--set", "first_frame.points=sfm"]
    assert run_command(["run", "--source", str(photographs(tmp_path / "fox")), *few]) == 2
    (made,) = re.findall(r"gsstream (scene prepare \S+ --out (\S+))$", capsys.readouterr().err.strip())
    assert run_command(made[0].split()) == 0
    capsys.readouterr()
    scene, rig = open_source(made[1]).info.train, open_source(FEW).info.train
    assert scene.ids == tuple(f"{number:04d}" for number in range(6))
    assert (scene.width, scene.height) == (304, 240)
    assert np.allclose(scene.viewmats, rig.viewmats, atol=1e-9)
    assert run_command(["run", "--source", made[1], *few]) == 0, capsys.readouterr().err
    (setting,) = re.findall(r"--set (\S+)$", capsys.readouterr().err, re.MULTILINE)
    assert run_command(["run", "--source", made[1], *few, "--overwrite", "--set", *shlex.split(setting)]) == 0
    assert " dB" in capsys.readouterr().err
    assert (tmp_path / "o" / "contact_sheet.png").stat().st_size > 1000


@pytest.mark.sfm
@needs_pycolmap
def test_what_ends_a_preparation_leaves_no_temporary_files(tmp_path: Path) -> None:
    raw, scratch = raw_pictures(tmp_path / "raw", 1), tmp_path / "scratch"
    scratch.mkdir()
    command = [sys.executable, "-c", MAIN, "scene", "prepare", str(raw), "--out", str(tmp_path / "scene")]
    with subprocess.Popen(command, env={**os.environ, "TMPDIR": str(scratch)}, stderr=subprocess.PIPE) as process:
        while not list(scratch.glob("gsstream-sfm-*/features.db")):
            assert process.poll() is None, "it ended before it could be ended"
            time.sleep(0.01)
        process.terminate()
        _, said = process.communicate(timeout=120)
    assert (process.returncode, said) == (143, b"ended by SIGTERM\n")
    assert list(scratch.iterdir()) == []


@pytest.mark.sfm
@needs_pycolmap
def test_many_photographs_are_matched_with_those_that_were_taken_about_then() -> None:
    """In a process of its own: it imports pycolmap."""
    code = (
        "from gsstream.input.seeds._features import pairs_by_place, pairs_in_order\n"
        "import json, numpy as np\n"
        "poses = np.tile(np.eye(4), (60, 1, 1)); poses[:, 0, 3] = -np.arange(60)\n"
        "names = list(map(str, range(60)))\n"
        "print(json.dumps([pairs_in_order(names), pairs_by_place(names, poses)]))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    in_order, by_place = json.loads(done.stdout)
    assert {min(abs(int(a) - int(b)), 60 - abs(int(a) - int(b))) for a, b in in_order} == {*range(1, 11), 16}
    assert len(in_order) == 60 * 11 < 60 * 59 / 2
    assert max(abs(int(a) - int(b)) for a, b in by_place) <= 20
    assert {number for pair in by_place for number in pair} == set(map(str, range(60)))
