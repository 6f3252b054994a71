"""A camera that is only half there: every reader leaves it out by name, and says how many stay."""

from __future__ import annotations

import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from test_rigs import FORMATS, NAMES, pictures
from tiny_recordings import LAYOUTS, SIZE, World, make_world, write_enerf

from gsstream.core.errors import SourceError
from gsstream.input.recordings.open import DEMO_FOLDER, open_source, read_layout
from gsstream.input.recordings.sync import RecordingWarning


@pytest.fixture(scope="module")
def world() -> World:
    return make_world(frames=2)


def in_text(name: str, old: str, new: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        path = folder / name
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new, 1))

    return change


def unregistered(folder: Path, camera: str) -> None:
    path = folder / "sparse/0/images.txt"
    lines = path.read_text().split("\n")
    at = next(i for i, line in enumerate(lines) if line.endswith(f"{camera}.png"))
    path.write_text("\n".join(lines[:at] + lines[at + 2 :]))


#: Layout, what is done to one of its four cameras, what is said.
HALVES: dict[str, tuple[str, Callable[[Path], Any], str]] = {
    "colmap without pictures": ("colmap folders", lambda f: shutil.rmtree(f / "images/cam02"), ": cam02; 3 of 4 stay"),
    "colmap without an image": ("colmap folders", lambda f: unregistered(f, "cam02"), r": cam02 \(1\); 3 cameras"),
    "easymocap without pictures": ("enerf", lambda f: shutil.rmtree(f / "images/02"), "pictures .*: 02; 3 of 4"),
    "easymocap without K": ("enerf", in_text("intri.yml", "K_02", "ccm_02"), r"without one of K.*: 02; 3 of 4 stay"),
    "easymocap without T": ("enerf", in_text("extri.yml", "T_02", "t_02"), r"without one of K.*: 02; 3 of 4 stay"),
    "easymocap without a name": ("enerf", lambda f: shutil.copytree(f / "images/01", f / "images/77"), "77; 4 of 5"),
}


@pytest.mark.parametrize("name", HALVES)
def test_half_a_camera_is_left_out_by_name(tmp_path: Path, world: World, name: str) -> None:
    layout, halve, said = HALVES[name]
    whole = open_source(str(LAYOUTS[layout].write(tmp_path / "whole", world)))
    folder = LAYOUTS[layout].write(tmp_path / "half", world)
    halve(folder)
    with pytest.warns(RecordingWarning, match=said):
        half = open_source(f"{LAYOUTS[layout].scheme}:{folder}")
    kept = [i for i, camera in enumerate(whole.info.train.ids) if camera in half.info.train.ids]
    assert len(kept) >= 2
    assert np.array_equal(half.info.train.viewmats, whole.info.train.viewmats[kept])
    assert np.array_equal(half.frame(0).images, whole.frame(0).images[kept])


RIGS: dict[str, tuple[str, Callable[[str], str], str]] = {
    "caliscope, null": (
        "caliscope",
        lambda t: t[: t.rindex("rotation =")] + 'rotation = "null"\ntranslation = "null"\n',
        "without a pose.*: cam_2; 2 of 3 stay",
    ),
    "caliscope, no table": ("caliscope", lambda t: t[: t.index("[cameras.2]")], "a calibration .*: cam_2; 2 of 3"),
    "anipose, another name": ("anipose", lambda t: t.replace('"cam_2"', '"rear"'), "without pictures .*: rear; 2 of 3"),
    "metashape, not aligned": (
        "metashape",
        lambda t: t[: t.rindex("<transform>")] + t[t.rindex("</transform>") + len("</transform>") :],
        "without a pose .*: cam_2; 2 of 3 stay",
    ),
    "opencv, a lens alone": ("opencv", lambda t: t.replace("T: ", "nframes: "), "a pose .*: cam_2; 2 of 3 stay"),
    "qualisys, not active": (
        "qualisys",
        lambda t: t.replace('active="1" serial="cam_2"', 'active="0" serial="cam_2"'),
        "without a calibration .*: cam_2; 2 of 3 stay",
    ),
}


@pytest.mark.parametrize("name", RIGS)
def test_half_a_camera_of_a_calibration_is_left_out_by_name(tmp_path: Path, name: str) -> None:
    layout, halve, said = RIGS[name]
    for place in ("whole", "half"):
        pictures(tmp_path / place)
        FORMATS[layout][0](tmp_path / place)
    files = [p for p in sorted((tmp_path / "half").rglob("*.*")) if p.suffix != ".png" and p.is_file()]
    files[-1].write_text(halve(files[-1].read_text()))
    with pytest.warns(RecordingWarning, match=said):
        half = open_source(str(tmp_path / "half"))
    whole = read_layout("calibrated", tmp_path / "whole")
    assert half.info.train.ids == NAMES[:2]
    assert np.allclose(half.info.train.viewmats, whole.rig.viewmats[:2])


def test_a_rig_of_lenses_alone_is_refused(tmp_path: Path) -> None:
    pictures(tmp_path / "rig")
    FORMATS["anipose"][0](tmp_path / "rig")
    path = tmp_path / "rig/calibration/rig.toml"
    path.write_text(path.read_text().replace("rotation =", "rotation_count ="))
    with pytest.raises(SourceError, match=r"without a pose .*calibrate the rig, too.*0 of 3 stay"):
        open_source(str(tmp_path / "rig"))


def test_easymocap_says_the_size_that_its_matrices_are_for(tmp_path: Path, world: World) -> None:
    plain = open_source(str(write_enerf(tmp_path / "plain", world))).info.train
    folder = write_enerf(tmp_path / "large", world)
    stated = "".join(f"W_{c:02d}: {2.0 * SIZE[0]}\nH_{c:02d}: {2 * SIZE[1]}\n" for c in range(4))
    text = (folder / "intri.yml").read_text() + stated
    for K in world.Ks:
        for value in {K[0, 0], K[1, 1]}:
            text = text.replace(repr(float(value)), repr(2 * float(value)))
        for value in {K[0, 2], K[1, 2]}:
            text = text.replace(f" {float(value) - 0.5!r},", f" {2 * float(value) - 0.5!r},")
        break  # all cameras have one K
    (folder / "intri.yml").write_text(text)
    with pytest.warns(RecordingWarning, match=r"4 of 4 cameras are calibrated for another size.*96 x 64 for 48 x 32"):
        fitted = open_source(str(folder)).info.train
    assert np.allclose(fitted.Ks, plain.Ks)
    (folder / "intri.yml").write_text(text.replace("W_01: 96.0", "W_01: 90.0"))
    with pytest.raises(SourceError, match=r"intri\.yml: camera '01' is calibrated for pictures of 90 x 64"):
        open_source(str(folder))


@pytest.mark.parametrize("count", [0, 1, 4, 5, 8, 12, 14])
def test_coefficients_of_zero_are_no_lens_however_many(tmp_path: Path, world: World, count: int) -> None:
    folder = write_enerf(tmp_path / "n", world)
    plain = open_source(str(folder)).info.train
    text = (folder / "intri.yml").read_text()
    zeros = ", ".join(["0.0"] * count)
    (folder / "intri.yml").write_text(text.replace("[0.0, 0.0, 0.0, 0.0, 0.0]", f"[{zeros}]"))
    assert np.array_equal(open_source(str(folder)).info.train.Ks, plain.Ks)


def test_eight_coefficients_bend_and_a_thirteenth_is_refused(tmp_path: Path, world: World) -> None:
    folder = write_enerf(tmp_path / "n", world)
    text = (folder / "intri.yml").read_text()
    (folder / "intri.yml").write_text(text.replace("[0.0, 0.0, 0.0, 0.0, 0.0]", "[0.1, 0, 0, 0, 0, 0.1, 0, 0]"))
    plain = open_source(str(folder))
    (folder / "intri.yml").write_text(text)
    straight = open_source(str(folder))
    # (1 + 0.1 r^2) / (1 + 0.1 r^2) is no distortion: the fourth coefficient divides.
    assert np.allclose(plain.info.train.Ks, straight.info.train.Ks, rtol=1e-3)
    (folder / "intri.yml").write_text(
        text.replace("[0.0, 0.0, 0.0, 0.0, 0.0]", "[0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0.1, 0]")
    )
    with pytest.raises(SourceError, match="expected 0, 4, 5, 8 or 12 coefficients"):
        open_source(str(folder))


@pytest.mark.parametrize(
    "rewrite",
    [
        lambda pairs: "".join(pose for pose, _ in pairs),
        lambda pairs: "".join(pose + "\n\n" for pose, _ in pairs),
        lambda pairs: "\n" + "".join(pose + points for pose, points in pairs),
        lambda pairs: "".join(pose + (points if i % 2 else "") for i, (pose, points) in enumerate(pairs)),
        lambda pairs: "".join((pose + points).replace("\n", "\r\n") for pose, points in pairs),
        lambda pairs: "".join("# a comment\n" + pose + "# points\n" + points for pose, points in pairs),
    ],
)
def test_no_image_of_a_text_model_is_lost(tmp_path: Path, world: World, rewrite: Callable[[Any], str]) -> None:
    folder = LAYOUTS["colmap folders"].write(tmp_path / "scene", world)
    whole = open_source(str(folder)).info.train
    path = folder / "sparse/0/images.txt"
    lines = [line + "\n" for line in path.read_text().split("\n") if line and not line.startswith("#")]
    path.write_bytes(rewrite(list(zip(lines[::2], lines[1::2], strict=True))).encode())
    found = open_source(str(folder)).info.train
    assert found.ids == whole.ids
    assert np.array_equal(found.viewmats, whole.viewmats)


def test_of_two_models_the_larger_is_read_and_said(tmp_path: Path, world: World) -> None:
    folder = LAYOUTS["colmap folders"].write(tmp_path / "scene", world)
    shutil.copytree(folder / "sparse/0", folder / "sparse/1")
    unregistered(folder, "cam01")
    unregistered(folder, "cam02")
    with pytest.warns(RecordingWarning, match=r"sparse/0 has 2 images, sparse/1 has 4 images; sparse/1 is read"):
        assert open_source(str(folder)).info.train.ids == ("cam00", "cam01", "cam02", "cam03")


def test_flat_pictures_of_later_instants_are_named(tmp_path: Path, world: World) -> None:
    folder = LAYOUTS["colmap folders"].write(tmp_path / "scene", world)
    for camera in sorted((folder / "images").iterdir()):
        for t, name in ((0, f"{camera.name}.png"), (1, f"{camera.name}_1.png")):
            shutil.move(camera / f"{t:04d}.png", folder / "images" / name)
        camera.rmdir()
    with pytest.warns(
        RecordingWarning, match=r"pictures without a pose are left out: cam00_1\.png, .*\(4\); 4 cameras"
    ):
        assert open_source(str(folder)).info.num_frames == 1


def test_cameras_json_is_taken_literally_and_depth_maps_are_no_camera(tmp_path: Path, world: World) -> None:
    """Who takes a camera out of it, as messages advise, is not told of its folder at every run."""
    folder = tmp_path / "demo"
    shutil.copytree(DEMO_FOLDER, folder)
    shutil.copytree(folder / "cam00", folder / "preview")
    nerf = LAYOUTS["nerfstudio"].write(tmp_path / "nerf", world)
    shutil.copytree(nerf / "images/cam1", nerf / "images/depth_frame0")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(open_source(str(folder)).info.train) == 8
        open_source(str(nerf))
    shutil.copytree(nerf / "images/cam1", nerf / "images/preview")
    with pytest.warns(
        RecordingWarning, match=r"transforms\.json: pictures without a pose are left out: preview \(1\); 4"
    ):
        open_source(str(nerf))
