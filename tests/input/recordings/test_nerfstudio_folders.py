"""transforms.json as tools write it: one flat folder, folders of instants, pictures that are missing."""

from __future__ import annotations

import json
import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from tiny_recordings import World, make_world, write_nerfstudio

from gsstream.core.errors import SourceError
from gsstream.input.recordings.open import open_source
from gsstream.input.recordings.sync import RecordingWarning


@pytest.fixture(scope="module")
def world() -> World:
    return make_world(frames=3)


def rewritten(folder: Path, world: World, name: Any, keep_time: bool = True) -> Path:
    """The timed layout with its files moved to ``name(camera, instant)``, entries in a scrambled order."""
    write_nerfstudio(folder, world, style="timed")
    file = folder / "transforms.json"
    data = json.loads(file.read_text())
    for entry in data["frames"]:
        old = Path(entry["file_path"])
        new = Path("images") / name(old.parent.name, int(old.stem))
        (folder / new).parent.mkdir(parents=True, exist_ok=True)
        (folder / old).rename(folder / new)
        entry["file_path"] = str(new)
        if not keep_time:
            del entry["time"]
    order = np.random.default_rng(0).permutation(len(data["frames"]))
    data["frames"] = [data["frames"][i] for i in order]
    data["test_filenames"] = [e["file_path"] for e in data["frames"] if "cam0" in e["file_path"]]
    file.write_text(json.dumps(data))
    return folder


def edit(folder: Path, change: Any) -> None:
    data = json.loads((folder / "transforms.json").read_text())
    change(data)
    (folder / "transforms.json").write_text(json.dumps(data))


WAYS = {
    "camera, then instant": (lambda c, t: f"{c}_{t:04d}.png", True),
    "instant, then camera": (lambda c, t: f"{t:04d}_{c}.png", True),
    "folders of instants": (lambda c, t: f"frame{t}/{c}.png", True),
    "names only": (lambda c, t: f"{c}_{t:04d}.png", False),
}


@pytest.mark.parametrize("way", WAYS)
def test_pictures_of_one_camera_are_found_together(way, tmp_path, world) -> None:
    expected = open_source(str(write_nerfstudio(tmp_path / "plain", world, style="timed")))
    found = open_source(str(rewritten(tmp_path / "flat", world, *WAYS[way])))
    assert found.info.num_frames == 3
    assert found.info.train.ids == expected.info.train.ids
    assert found.info.test.ids == expected.info.test.ids == ("cam0",)
    assert np.array_equal(found.info.train.viewmats, expected.info.train.viewmats)
    for t in range(3):
        assert np.array_equal(found.frame(t).images, expected.frame(t).images)


def test_names_that_tell_nothing_apart_become_numbers(tmp_path, world) -> None:
    names = iter(np.random.default_rng(1).permutation(1000))
    found = open_source(str(rewritten(tmp_path / "n", world, lambda c, t: f"{next(names):04d}.png")))
    assert found.info.num_frames == 3
    cameras = (*found.info.train.ids, *found.info.test.ids)
    assert sorted(cameras) == [f"cam{i:02d}" for i in range(len(world.poses))]


def test_cameras_with_other_intrinsics_are_others(tmp_path, world) -> None:
    """Two lenses in one place: equal poses, different focal lengths."""
    folder = rewritten(tmp_path / "n", world, lambda c, t: f"{c}_{t:04d}.png")

    def twin(data: dict[str, Any]) -> None:
        first, second = ([e for e in data["frames"] if f"/cam{i}_" in e["file_path"]] for i in (1, 2))
        for a, b in zip(first, second, strict=True):
            b["transform_matrix"] = a["transform_matrix"]
            b["fl_x"] = b["fl_y"] = 2 * a["fl_x"]

    edit(folder, twin)
    assert open_source(str(folder)).info.num_frames == 3


FAULTS = {
    "moving camera": (
        lambda d: [e["transform_matrix"][0].__setitem__(3, i) for i, e in enumerate(d["frames"])],
        "each from another pose: a camera that moves",
    ),
    "a time is missing": (lambda d: d["frames"].pop(0), "has no picture of time"),
    "a time twice": (
        lambda d: d["frames"][0].update(time=d["frames"][0]["time"] + 0.1),
        "two pictures of time|no picture",
    ),
    "time is text": (lambda d: d["frames"][0].update(time="now"), "must be a finite number"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_what_is_no_recording_is_refused_in_one_sentence(fault, tmp_path, world) -> None:
    folder = rewritten(tmp_path / "n", world, lambda c, t: f"{c}_{t:04d}.png")
    change, said = FAULTS[fault]
    edit(folder, change)
    with pytest.raises(SourceError, match=said):
        open_source(str(folder))


def still_scene(folder: Path, world: World) -> Path:
    """One picture per camera."""
    write_nerfstudio(folder, world, style="timed")

    def first_only(data: dict[str, Any]) -> None:
        first = [entry for entry in data["frames"] if entry.pop("time") == 0]
        data["frames"] = first
        data["test_filenames"] = [entry["file_path"] for entry in first if "cam0" in entry["file_path"]]

    edit(folder, first_only)
    return folder


def test_missing_pictures_are_skipped_with_a_count_or_refused(tmp_path, world) -> None:
    folder = still_scene(tmp_path / "n", world)
    (folder / "images" / "cam2" / "0000.png").unlink()
    number = len(world.poses)
    with pytest.warns(RecordingWarning, match=rf"1 of {number} pictures are missing, the first is images/cam2/0"):
        source = open_source(str(folder))
    assert len(source.info.train) + len(source.info.test) == number - 1
    with pytest.raises(SourceError, match="restore them"):
        open_source(f"nerfstudio:{folder}?missing=refuse")
    with pytest.warns(RecordingWarning):
        open_source(f"nerfstudio:{folder}?missing=skip")
    with pytest.raises(SourceError, match=r"expected .missing=skip or"):
        open_source(f"nerfstudio:{folder}?lost=skip")
    for path in (folder / "images").rglob("*.png"):
        path.unlink()
    with pytest.raises(SourceError, match="restore them"):
        open_source(str(folder))


@pytest.mark.parametrize("timed", [True, False])
def test_a_hole_in_a_recording_never_shifts_a_camera(timed, tmp_path, world) -> None:
    folder = rewritten(tmp_path / "n", world, lambda c, t: f"{c}_{t:04d}.png", timed)
    (folder / "images" / "cam1_0001.png").unlink()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RecordingWarning)
        with pytest.raises(SourceError, match=r"no picture of time|shifted|holes"):
            open_source(str(folder))


def test_cameras_of_two_sizes_name_the_command_that_mends_it(tmp_path, world) -> None:
    """One camera has pictures of half the size; the intrinsics of the file still fit its view."""
    folder = write_nerfstudio(tmp_path / "n", world)
    for path in (folder / "images" / "cam1").iterdir():
        Image.open(path).reduce(2).save(path)
    with (
        pytest.raises(SourceError, match=r"one image size.*gsstream scene prepare"),
        pytest.warns(RecordingWarning, match="1 of 4 cameras are calibrated for another size"),
    ):
        open_source(str(folder))


def split_files(folder: Path, timed: bool) -> tuple[str, str]:
    """The same cameras as one transforms.json, and as Blender's files per split, each with its own shared keys."""
    world = make_world(views=4, frames=3 if timed else 1)
    write_nerfstudio(folder / "one", world, style="timed" if timed else "folders")
    data = json.loads((folder / "one" / "transforms.json").read_text())
    del data["ply_file_path"]
    (folder / "one" / "transforms.json").write_text(json.dumps(data))
    entries, tests = data.pop("frames"), data.pop("test_filenames")
    (folder / "split").mkdir()
    for number, entry in enumerate(entries):
        held = entry["file_path"] in tests
        picture = folder / "one" / entry["file_path"]
        place = folder / "split" / ("test" if held else "train")
        place.mkdir(exist_ok=True)
        (place / f"r_{number}.png").write_bytes((picture if timed else picture / "0000.png").read_bytes())
        entry["file_path"], entry["held"] = f"./{place.name}/r_{number}", held
    for name, held in (("train", False), ("test", True)):
        own = [
            {k: v for k, v in entry.items() if k not in ("held", "fl_x")} for entry in entries if entry["held"] == held
        ]
        # One focal length for the file, as Blender's add-ons write it.
        shared = {"camera_angle_x": 2 * math.atan(data["w"] / 2 / entries[0]["fl_x"])}
        (folder / "split" / f"transforms_{name}.json").write_text(json.dumps({**data, **shared, "frames": own}))
    return str(folder / "one"), str(folder / "split")


@pytest.mark.parametrize("timed", [False, True])
def test_a_file_per_split_is_read_as_one_file_with_lists(tmp_path: Path, timed: bool) -> None:
    one, split = (open_source(name) for name in split_files(tmp_path, timed))
    assert split.info.num_frames == one.info.num_frames == (3 if timed else 1)
    assert split.info.fps == 25
    for a, b in ((split.info.train, one.info.train), (split.info.test, one.info.test)):
        assert np.allclose(a.viewmats, b.viewmats)
        assert np.allclose(a.Ks, b.Ks)
    for t in range(one.info.num_frames or 0):
        for kind in ("train", "test"):
            assert np.array_equal(split.frame(t, kind).images, one.frame(t, kind).images)  # type: ignore[arg-type]
    assert timed or split.info.test.ids == ("test_r_0",)
