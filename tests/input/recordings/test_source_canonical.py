"""A recording in the coordinates of its rig: whatever its files say, runs see the same cameras and points."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from similar_worlds import Moved, world

from gsstream.core.errors import SourceError
from gsstream.core.world import World
from gsstream.encode import open_recording, to_rig_coordinates
from gsstream.input.recordings.open import DEMO_FOLDER, open_source
from gsstream.recipe.model import Recipe

FAR = world(1e3, (5e8, 5.2e9, 3e5), turn=2)  # millimetres in UTM coordinates


def write_moved(folder: Path, where: World) -> None:
    """The demo with its calibration and points in another world, as files."""
    shutil.copytree(DEMO_FOLDER, folder)
    data = json.loads((folder / "cameras.json").read_text())
    for camera in data["cameras"]:
        pose = np.array(camera["w2c"])
        turned = pose[:3, :3] @ where.matrix.T
        pose[:3, 3] = where.scale * pose[:3, 3] - turned @ np.array(where.offset)
        pose[:3, :3] = turned
        camera["w2c"] = pose.tolist()
    (folder / "cameras.json").write_text(json.dumps(data))
    with np.load(folder / "points_frame0.npz") as arrays:
        moved = {name: where.points(array) if name.endswith("xyz") else array for name, array in arrays.items()}
    np.savez(folder / "points_frame0.npz", **moved)


def test_files_of_another_world_are_the_same_recording(tmp_path):
    write_moved(tmp_path / "far", FAR)
    with open_recording("demo") as here, open_recording(str(tmp_path / "far")) as there:
        for split in ("train", "test"):
            ours, theirs = getattr(here.info, split), getattr(there.info, split)
            assert theirs.viewmats == pytest.approx(ours.viewmats, abs=1e-8)
            assert np.array_equal(theirs.Ks, ours.Ks)
            assert np.array_equal(there.frame(3, split).images, here.frame(3, split).images)
            assert np.array_equal(there.frame(3, split).cameras.viewmats, theirs.viewmats)
        for kind in ("recording", "sparse"):
            cloud, other = here.points(kind), there.points(kind)
            assert cloud.xyz.dtype == other.xyz.dtype == np.float32
            assert other.xyz == pytest.approx(cloud.xyz, abs=1e-6)
        # The worlds lead back to what the files say.
        raw = open_source(str(tmp_path / "far"))
        assert there.info.world.points(there.points().xyz) == pytest.approx(raw.points().xyz, rel=0, abs=1e-2)
        back = there.info.world.cameras(there.info.train)
        assert back.centers == pytest.approx(raw.info.train.centers, rel=0, abs=1e-2)  # of 5e9 millimetres
        assert there.info.world.is_near(FAR.after(here.info.world))


def test_the_split_does_not_move_the_world():
    other = Recipe.model_validate({"data": {"test_cameras": ["cam00", "cam10"], "train_views": 3}})
    with open_recording("demo") as whole, open_recording("demo", other) as part:
        assert part.info.world == whole.info.world
        assert len(part.info.train) == 3


def test_a_source_of_ones_own_is_placed_and_closed():
    source = to_rig_coordinates(Moved(open_source("synthetic:frames=1&views=3&width=16&height=12"), FAR))
    assert source.info.train.extent == pytest.approx(1, abs=0.2), "test cameras count, too"
    assert source.points() is not None
    source.close()


def test_a_point_that_no_packet_could_hold_is_named(tmp_path):
    write_moved(tmp_path / "far", world())
    with np.load(tmp_path / "far" / "points_frame0.npz") as arrays:
        changed = dict(arrays)
    changed["xyz"] = changed["xyz"].astype(np.float64)
    changed["xyz"][7] = 1e20
    np.savez(tmp_path / "far" / "points_frame0.npz", **changed)
    with open_recording(str(tmp_path / "far")) as source, pytest.raises(SourceError, match=r"1e\+12 times the size"):
        source.points()
