"""Faulty folders: each ends in one line that names the file, what is wrong and what to do. None is read in silence."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tiny_recordings import (
    LAYOUTS,
    SIZE,
    World,
    make_world,
    write_colmap,
    write_frames,
    write_n3dv,
    write_ply,
    write_png,
)

from gsstream.core.errors import SourceError
from gsstream.discovery.catalog import load_catalog
from gsstream.engine.run.recording import open_recording
from gsstream.input.recordings.open import open_source
from gsstream.input.recordings.options import DataOptions
from gsstream.input.recordings.transformed import transformed
from gsstream.recipe.load import resolve_recipe

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def world() -> World:
    return make_world(frames=2)


def edit_json(name: str, edit: Callable[[dict[str, Any]], Any]) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        data = json.loads((folder / name).read_text())
        edit(data)
        (folder / name).write_text(json.dumps(data))

    return change


def edit_rows(edit: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    return lambda folder: np.save(folder / "poses_bounds.npy", edit(np.load(folder / "poses_bounds.npy")))


def edit_text(name: str, old: str, new: str) -> Callable[[Path], None]:
    def change(folder: Path) -> None:
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new, 1))

    return change


def set_cell(row: int, column: int, value: float) -> Callable[[np.ndarray], np.ndarray]:
    def change(rows: np.ndarray) -> np.ndarray:
        rows[row, column] = value
        return rows

    return change


def frame(number: int, **values: Any) -> Callable[[dict[str, Any]], Any]:
    return lambda data: data["frames"][number].update(values)


def mirrored(data: dict[str, Any]) -> None:
    matrix = np.array(data["frames"][1]["transform_matrix"])
    matrix[:3, 0] *= -1
    data["frames"][1]["transform_matrix"] = matrix.tolist()


def moving(data: dict[str, Any]) -> None:
    data["frames"][1]["transform_matrix"][0][3] += 0.1


def drifting(data: dict[str, Any]) -> None:
    data["w2c"] = json.loads(json.dumps(data["w2c"]))
    data["w2c"][1][0][0][3] += 0.5


FAULTS: dict[str, tuple[str, Callable[[Path], Any], str]] = {
    "rows": ("n3dv images", edit_rows(lambda r: r[:3]), r"3 rows for 4 cameras \(cam00, cam01, cam02, cam03\)"),
    "columns": ("n3dv images", edit_rows(lambda r: r[:, :12]), r"expected an array \[cameras, 17\]"),
    "nan pose": ("n3dv images", edit_rows(set_cell(2, 3, np.nan)), "row 2 holds a value that is not finite"),
    "focal": ("n3dv images", edit_rows(set_cell(1, 14, -5)), "camera 'cam01': expected positive height"),
    "shape": ("n3dv images", edit_rows(set_cell(1, 4, 48)), "for pictures of 48 x 48, but those found are 48 x 32"),
    "handedness": ("n3dv images", edit_rows(set_cell(1, 1, 9)), "'cam01': the 3x3 part is not a rotation"),
    "npy": ("n3dv images", lambda f: (f / "poses_bounds.npy").write_bytes(b"no array"), "cannot be read as a numpy"),
    "gap": ("n3dv images", lambda f: [write_frames(f / f"cam0{c}/images", np.zeros((2, 32, 48, 3), np.uint8),
                                                   first=3 if c == 1 else 2) for c in range(4)],
            "camera 'cam01': frame 2 is missing"),
    "size": ("n3dv images", lambda f: [write_png(f / f"cam02/images/000{t}.png", np.zeros((16, 24, 3), np.uint8))
                                       for t in (0, 1)], "must share one image size, got .*cam02 24 x 16"),
    "late size": ("n3dv images", lambda f: write_png(f / "cam02/images/0001.png", np.zeros((8, 8, 3), np.uint8)),
                  "is 8 x 8 pixels, but the first image of its camera has 48 x 32"),
    "instant": ("n3dv instants", lambda f: (f / "frame000002/cam01.png").unlink(), "cam01.png: the picture is missing"),
    "no image": ("n3dv folders", lambda f: (f / "cam03/0000.png").write_text("?"), "image cannot be opened"),
    "yaml": ("enerf", lambda f: (f / "intri.yml").write_text("names: ["), r"intri\.yml: not valid YAML"),
    "no matrices": ("enerf", lambda f: (f / "intri.yml").write_text("names: [\"00\", \"01\"]"), "0 of 4 stay"),
    "word": ("enerf", edit_text("intri.yml", "data: [", "data: [x, "), "not a number"),
    "no names": ("enerf", edit_text("intri.yml", "names", "cams"), "'names' must list the cameras"),
    "meta": ("panoptic", edit_json("train_meta.json", lambda d: d.pop("w2c")), "missing: w2c"),
    "json": ("panoptic", lambda f: (f / "train_meta.json").write_text("{"), "not valid JSON"),
    "drift": ("panoptic", edit_json("train_meta.json", drifting), "'w2c' changes with time, first at instant 1"),
    "names": ("panoptic", edit_json("train_meta.json", lambda d: d.update(fn=[["1/0.png"]] * 2)), "'fn' must name one"),
    "twice": ("panoptic", edit_json("train_meta.json", lambda d: d.update(cam_id=[[0, 2, 3]] * 2)), "'cam0' is there"),
    "escape": ("panoptic", edit_json("train_meta.json", lambda d: d["fn"][0].__setitem__(0, "../../x.png")),
               "must stay inside"),
    "picture": ("panoptic", lambda f: (f / "ims/2/000001.png").unlink(), "000001.png: the picture is missing"),
    "text model": ("colmap folders", edit_text("sparse/0/cameras.txt", "PINHOLE", "PINHOLES"), r"\.txt:2: not a line"),
    "text pose": ("colmap folders", edit_text("sparse/0/images.txt", " cam00.png", ""), r"images\.txt:3: not a line"),
    "lens": ("colmap folders", edit_text("sparse/0/cameras.txt", "1 PINHOLE 48 32 ", "1 EUCM 48 32 0.5 1 "),
             "the model EUCM is not supported"),
    "lost camera": ("colmap folders", edit_text("sparse/0/cameras.txt", "2 PINHOLE", "9 PINHOLE"), "which is not in"),
    "no frames": ("colmap folders", lambda f: (f / "images").rename(f / "pictures"), "without pictures .* 0 of 4 stay"),
    "entries": ("nerfstudio", edit_json("transforms.json", lambda d: d.update(frames=[])), "'frames' must be"),
    "no path": ("nerfstudio", edit_json("transforms.json", frame(1, file_path=None)), "frame 1 has no 'file_path'"),
    "mirror": ("nerfstudio", edit_json("transforms.json", mirrored), "'cam1': the 3x3 part is not a rotation"),
    "moving": ("nerfstudio timed", edit_json("transforms.json", moving), "a camera that moves"),
    "model": ("nerfstudio", edit_json("transforms.json", lambda d: d.update(camera_model="EQUIRECTANGULAR")),
              "'EQUIRECTANGULAR' of camera '.*' is not supported; expected"),
    "focal text": ("nerfstudio", edit_json("transforms.json", frame(2, fl_x="wide")), "fl_x of camera 'cam2' must be"),
    "outside": ("nerfstudio", edit_json("transforms.json", frame(0, file_path="/etc/x.png")), "must stay inside"),
    "folds": ("nerfstudio", edit_json("transforms.json", lambda d: d.update(k1=-40.0)), "leaves no usable picture"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_each_fault_has_its_message(tmp_path: Path, world: World, fault: str) -> None:
    name, spoil, message = FAULTS[fault]
    layout = LAYOUTS[name]
    folder = layout.write(tmp_path / "scene", world)
    spoil(folder)
    with pytest.raises(SourceError, match=message) as caught:
        open_source(f"{layout.scheme}:{folder}").frame(1)
    assert str(folder) in str(caught.value)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
def test_binary_models_cut_anywhere_are_named(tmp_path: Path, world: World, name: str) -> None:
    folder = write_colmap(tmp_path / "scene", world, frames="images")
    path = folder / "sparse" / "0" / name
    data = path.read_bytes()
    for kept in sorted({0, 4, 8, 20, len(data) // 3, len(data) // 2, len(data) - 1}):
        path.write_bytes(data[:kept])
        with pytest.raises(SourceError, match=rf"{name.replace('.', r'[.]')}: (cut|byte|a name)"):
            open_source(str(folder)).points()
    path.write_bytes(b"\xff" * len(data))
    with pytest.raises(SourceError, match="announces"):
        open_source(str(folder)).points()


@given(st.binary(min_size=1, max_size=40), st.integers(0, 10_000))
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_overwritten_binary_models_are_refused_or_valid(tmp_path: Path, world: World, junk: bytes, at: int) -> None:
    folder = tmp_path / "scene"
    if not folder.exists():
        write_colmap(folder, world, frames="images")
        for path in sorted((folder / "sparse/0").iterdir()):
            path.with_suffix(".good").write_bytes(path.read_bytes())
    goods = sorted((folder / "sparse/0").glob("*.good"))
    for good in goods:
        good.with_suffix(".bin").write_bytes(good.read_bytes())
    data = bytearray(goods[at % 3].read_bytes())
    data[at % len(data) : at % len(data) + len(junk)] = junk
    goods[at % 3].with_suffix(".bin").write_bytes(bytes(data))
    try:
        source = open_source(str(folder))
    except SourceError:
        return
    source.info.train.validate()


def test_ply_faults_and_kinds(tmp_path: Path, world: World) -> None:
    folder = write_n3dv(tmp_path / "scene", world, style="folders")
    path = folder / "points3D_downsample2.ply"

    def points():
        return transformed(open_source(str(folder)), DataOptions(leak="points")).points()

    path.write_text(
        "ply\nformat ascii 1.0\nelement vertex 2\nproperty double x\nproperty double y\nproperty double z\n"
        "end_header\n1 2 3\n4 5 6\n"
    )
    np.testing.assert_array_equal(points().xyz, [[1, 2, 3], [4, 5, 6]])
    assert (points().rgb == 0.5).all()
    for spoil, message in {
        b"solid stl": "not a PLY file",
        path.read_bytes().replace(b"ascii", b"binary_big_endian"): "expected ascii or binary_little_endian",
        path.read_bytes().replace(b"vertex 2", b"vertex 3"): "3 rows are announced, 2 are there",
        path.read_bytes().replace(b"double z", b"double w"): "no x, y, z",
        path.read_bytes().replace(b"4 5 6", b"4 5 nan"): "1 of 2 points are not finite",
        path.read_bytes().replace(b"property double x", b"property list uchar int x"): "is not a plain number",
    }.items():
        path.write_bytes(spoil)
        with pytest.raises(SourceError, match=message):
            points()
    write_ply(path, world.xyz, world.rgb)
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(SourceError, match="cut short"):
        points()


@pytest.mark.parametrize(("name", "recipe"), [("n3dv", "n3dv"), ("meetroom", "meetroom"), ("enerf", "enerf_outdoor")])
def test_data_set_recipes_state_split_size_and_frames(tmp_path: Path, world: World, name: str, recipe: str) -> None:
    catalog = load_catalog()
    file = ROOT / "configs" / "recordings" / f"{recipe}.yaml"
    resolved = resolve_recipe("dense", catalog.recipe_path, (file,), [])
    assert resolved.recipe.frames == 300
    assert resolved.recipe.data.leak == "none"
    assert resolved.recipe.data.test_cameras == LAYOUTS[name].test
    assert f"{recipe}.yaml" in resolved.origin(("data", "test_cameras")).label
    folder = LAYOUTS[name].write(tmp_path / "scene", world)
    source = open_recording(f"{name}:{folder}", resolved.recipe, catalog)
    assert source.info.train.width == round(SIZE[0] * resolved.recipe.scale)
    assert source.info.test.ids == LAYOUTS[name].test
