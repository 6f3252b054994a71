"""Seeds from depth maps, from points that their maker trusts, and from triangulation."""

from __future__ import annotations

import ast
import importlib.util
import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rigs import HEIGHT, WIDTH, inwards

from gsstream.core.cameras import Cameras
from gsstream.core.errors import InputError, SourceError
from gsstream.encode import to_rig_coordinates
from gsstream.engine.fit import constants
from gsstream.engine.frame0.points import gather_points
from gsstream.input.recordings.depth_maps import read_depth_maps
from gsstream.input.recordings.open import open_source
from gsstream.input.recordings.pointfiles import read_points
from gsstream.input.recordings.primitives import cast
from gsstream.input.recordings.synthetic import SyntheticSource
from gsstream.input.seeds import mapping, sfm
from gsstream.input.seeds.geometry import pixel_centers
from gsstream.input.seeds.seeding import photo_consistent_seeds
from gsstream.input.seeds.sweep import SweepSettings
from gsstream.recipe.model import FirstFrame

RING = inwards(5, 360)
BALL, RADIUS = np.array([0.2, -0.1, 0.15]), 0.5


def ball_depths(cameras: Cameras) -> np.ndarray:
    """[C, H, W] planar depth of a ball, by the formula of a ray and a sphere; NaN beside it."""
    pixels = pixel_centers(cameras.width, cameras.height)
    rays = np.concatenate([pixels, np.ones((len(pixels), 1))], 1) @ np.linalg.inv(cameras.Ks[0]).T
    depths = []
    for view, start in enumerate(cameras.centers):
        way = rays @ cameras.viewmats[view, :3, :3]
        square, half = (way**2).sum(1), way @ (start - BALL)
        inner = half**2 - square * ((start - BALL) @ (start - BALL) - RADIUS**2)
        depths.append(np.where(inner > 0, (-half - np.sqrt(np.maximum(inner, 0))) / square, np.nan))
    return np.reshape(depths, (len(cameras), cameras.height, cameras.width)).astype(np.float32)


def test_seeds_lie_where_the_depth_maps_say_even_of_one_camera_alone() -> None:
    images = np.random.default_rng(1).random((1, HEIGHT, WIDTH, 3)).astype(np.float32)
    cameras = RING.select([0])
    depths = ball_depths(cameras)
    seeds = photo_consistent_seeds(images, cameras, 10_000, known=depths).points
    assert len(seeds) == np.isfinite(depths).sum()
    np.testing.assert_allclose(np.linalg.norm(seeds.xyz - BALL, axis=1), RADIUS, atol=1e-4)
    with pytest.raises(InputError, match="at least 3 training cameras"):
        photo_consistent_seeds(images, cameras, 100, known=np.full_like(depths, np.nan))


def test_what_is_given_stays_and_the_others_are_looked_for() -> None:
    images = np.random.default_rng(2).random((5, HEIGHT, WIDTH, 3)).astype(np.float32)
    known = np.full((5, HEIGHT, WIDTH), np.nan, np.float32)
    known[1, 10:30, 20:40] = 1.7
    quick = SweepSettings(planes=16, neighbours=2)
    found = photo_consistent_seeds(images, RING, 50_000, known=known, settings=quick).points
    assert "depth maps of 1" in found.origin
    local = found.xyz @ RING.viewmats[1, :3, :3].T + RING.viewmats[1, :3, 3]
    assert (np.abs(local[:, 2] - 1.7) < 1e-4).sum() >= 20 * 20


def write(folder: Path, unit: float = 1.0) -> Path:
    """A recording of three cameras that see a ball, with its depth maps, in units of ``unit`` of the rig's metres."""
    cameras, rng = RING.select([0, 1, 2]), np.random.default_rng(3)
    depths = ball_depths(cameras)
    (folder / "depth_frame0").mkdir(parents=True)
    rows = []
    for view, name in enumerate(cameras.ids):
        picture = (255 * rng.random((HEIGHT, WIDTH, 3))).astype(np.uint8)
        Image.fromarray(picture).save(folder / f"{name}.png")
        np.save(folder / "depth_frame0" / f"{name}.npy", depths[view].astype(np.float64) / unit)
        pose = cameras.viewmats[view].copy()
        pose[:3, 3] /= unit
        size = {"width": WIDTH, "height": HEIGHT, "split": "train", "frames": f"{name}.png"}
        rows.append({"id": name, "K": cameras.Ks[view].tolist(), "w2c": pose.tolist(), **size})
    text = {"schema": "opencv-multiview-1", "name": "ball", "fps": 30, "frames": 1, "cameras": rows}
    (folder / "cameras.json").write_text(json.dumps(text))
    return folder


def test_depth_is_in_the_units_of_the_poses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(constants, "PIXELS_PER_SEED", 1)  # the pictures are tiny
    found = []
    for unit in (1.0, 1e-3, 0.3048):
        source = to_rig_coordinates(open_source(str(write(tmp_path / f"{unit}", unit))))
        seeds = gather_points(source, source.frame(0), FirstFrame())
        assert seeds.origin.startswith("depth maps of 3 cameras")
        found.append(source.info.world.points(seeds.xyz) * unit)
    away = np.abs(np.linalg.norm(found[0] - BALL, axis=1) - RADIUS)
    assert (away < 0.02).mean() > 0.1, "many pixels show the ball; thinning leaves more of the walls"
    for other in found[1:]:
        np.testing.assert_allclose(other, found[0], atol=1e-4)


def test_maps_are_brought_to_the_size_of_the_pictures(tmp_path: Path) -> None:
    deep = np.arange(1.0, 1 + 16 * HEIGHT * WIDTH).reshape(4 * HEIGHT, 4 * WIDTH)
    deep[:4, :16], deep[:4, 16:32], deep[:4, 32:48] = 0, np.inf, 1e300
    np.save(tmp_path / "cam0.npy", deep)
    found = read_depth_maps(tmp_path, RING.select([0, 1]), unit=2.0)
    assert found is not None
    np.testing.assert_array_equal(found[0][1:], deep[6::4, 2::4].astype(np.float32) / 2)
    assert np.isnan(found[0][0, :12]).all()
    assert np.isfinite(found[0][0, 12:]).all()
    assert np.isnan(found[1]).all(), "this camera has none"
    assert read_depth_maps(tmp_path / "nowhere", RING) is None


def text_file(path: Path) -> None:
    path.write_text("no array")


def array(values: np.ndarray) -> Callable[[Path], None]:
    return lambda path: np.save(path, values)


@pytest.mark.parametrize(
    ("write_it", "message"),
    [
        (text_file, "cam0.npy: cannot be read as a numpy array"),
        (array(np.zeros((HEIGHT, WIDTH, 1))), r"got \[48, 64, 1\] float64"),
        (array(np.full((HEIGHT, WIDTH), "deep")), "expected planar depth"),
        (array(np.zeros((0, 0))), "got 0 x 0"),
        (array(np.zeros((HEIGHT, HEIGHT))), "got 48 x 48"),
    ],
)
def test_a_file_that_does_not_fit_is_named(tmp_path: Path, write_it: Callable[[Path], None], message: str) -> None:
    write_it(tmp_path / "cam0.npy")
    with pytest.raises(SourceError, match=message):
        read_depth_maps(tmp_path, RING)


def test_points_that_their_maker_does_not_trust_are_left_out(tmp_path: Path) -> None:
    xyz, rgb = np.arange(12.0).reshape(4, 3), np.arange(12, dtype=np.uint8).reshape(4, 3)
    path = tmp_path / "points_frame0.npz"
    np.savez(path, xyz=xyz, rgb=rgb, confidence=np.array([0.2, 0.9, 0.5, 0.49]))
    np.testing.assert_array_equal(read_points(path, "recording").xyz, xyz[[1, 2]])
    for wrong, message in (
        (np.ones(3), r"expected confidence \[4\] from 0 to 1, got \[3\]"),
        (np.array([0, 1, 2, 3.0]), "from 0 to 1"),
        (np.array([np.nan, 1, 1, 1]), "from 0 to 1"),
        (np.full(4, 0.1), "below 0.5 for every point"),
    ):
        np.savez(path, xyz=xyz, rgb=rgb, confidence=wrong)
        with pytest.raises(SourceError, match=message):
            read_points(path, "recording")


needs_pycolmap = pytest.mark.skipif(importlib.util.find_spec("pycolmap") is None, reason="pycolmap is not installed")


@pytest.mark.sfm
@needs_pycolmap
def test_points_lie_on_the_true_surfaces_and_repeat() -> None:
    source = SyntheticSource.from_query("width=320&height=240&views=8")
    images, cameras = source.frame(0).images, source.info.train
    points = mapping.triangulate_points(images, cameras)
    assert len(points) > 80
    shapes = source._static + source._scene.moving(0)
    error = np.full(len(points), np.inf)
    for center in cameras.centers:
        hits = cast(center, (points.xyz - center).astype(np.float32), shapes)
        error = np.minimum(error, np.abs(hits.distance - 1))
    assert np.median(error) < 0.005
    assert (error < 0.03).mean() > 0.9
    assert 0 < points.rgb.mean() < 1
    assert mapping.triangulate_points(images, cameras).xyz.tobytes() == points.xyz.tobytes()


IN_ITS_PROCESS = (
    "import sys, hashlib, shutil, zlib\n"
    "from pathlib import Path\n"
    "from gsstream.input.seeds import _features, _pycolmap\n"
    "import numpy as np\n"
    "here = Path(sys.argv[1])\n"
)


def printed_of_pycolmap(code: str, folder: Path, *arguments: str) -> list[str]:
    """What the lines after IN_ITS_PROCESS print, in a process of their own that may load pycolmap."""
    command = [sys.executable, "-c", IN_ITS_PROCESS + code, os.fspath(folder), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


@pytest.mark.sfm
@needs_pycolmap
def test_no_number_of_threads_changes_a_bit_of_a_point(tmp_path: Path) -> None:
    """COLMAP's threads finish pictures and pairs in any order; what comes of them is the same, of whatever stage."""
    source = SyntheticSource.from_query("width=320&height=240&views=6")
    sfm.write_images(tmp_path, source.frame(0).images)
    sfm.write_rig(tmp_path, source.info.train)
    code = (
        "for threads in map(int, sys.argv[2:]):\n"
        "    folder = here / f'{threads}'\n"
        "    shutil.copytree(here / 'images', folder / 'images')\n"
        "    shutil.copy(here / 'rig.npz', folder)\n"
        "    _features.processors = lambda: threads\n"
        "    _pycolmap.triangulate(folder)\n"
        "    with np.load(folder / 'points.npz') as found:\n"
        "        sums = {name: hashlib.sha256(found[name].tobytes()).hexdigest() for name in sorted(found)}\n"
        "    print('points', len(found.files), sums)\n"
    )
    printed = printed_of_pycolmap(code, tmp_path, "1", "2", "3", "16")
    found = [line for line in printed if line.startswith("points 7 ")]
    assert len(found) == 4
    assert len(set(found)) == 1


@pytest.mark.sfm
@needs_pycolmap
def test_the_same_features_are_matched_alike_twenty_times(tmp_path: Path) -> None:
    """Several threads of pycolmap's matching disturb each other, now and then: one matching in fifty came out other."""
    sfm.write_images(tmp_path, SyntheticSource.from_query("width=320&height=240&views=8").frame(0).images)
    code = (
        "_features.processors = lambda: 4\n"
        "database = _features.extract(here, most=2048)\n"
        "for turn in range(20):\n"
        "    again = Path(shutil.copy(database, here / f'{turn}.db'))\n"
        "    _features.match_pairs(here, again, _features.all_pairs(here))\n"
        "    total = hashlib.sha256()\n"
        "    with _pycolmap.pycolmap.Database.open(again) as db:\n"
        "        numbers = sorted(image.image_id for image in db.read_all_images())\n"
        "        pairs = [(a, b) for a in numbers for b in numbers if a < b]\n"
        "        found = [np.asarray(db.read_matches(a, b)) for a, b in pairs]\n"
        "    total.update(b''.join(matches.tobytes() for matches in found))\n"
        "    print('matches', sum(map(len, found)) > 1000, total.hexdigest())\n"
    )
    found = [line for line in printed_of_pycolmap(code, tmp_path) if line.startswith("matches True ")]
    assert len(found) == 20
    assert len(set(found)) == 1


@needs_pycolmap
def test_linear_algebra_takes_one_thread_whatever_the_environment_says() -> None:
    """How many threads a library takes while others work is a question of timing, and last bits follow it."""
    code = (
        "import os, ctypes\n"
        "import gsstream.input.seeds._pycolmap\n"
        "libraries = {line.split()[-1] for line in open('/proc/self/maps') if 'gomp' in line}\n"
        "print([os.environ['OMP_NUM_THREADS'], *(ctypes.CDLL(path).omp_get_max_threads() for path in libraries)])\n"
    )
    environment = {**os.environ, "OMP_NUM_THREADS": "7"}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stderr
    name, *found = ast.literal_eval(done.stdout)
    assert name == "1"
    assert set(found) <= {1}


@pytest.mark.sfm
@needs_pycolmap
def test_images_without_features_are_explained() -> None:
    source = SyntheticSource.from_query("width=64&height=48&views=3")
    with pytest.raises(InputError, match="found no points in 3 training images of 64 x 48"):
        mapping.triangulate_points(np.full((3, 48, 64, 3), 0.5, np.float32), source.info.train)


@pytest.mark.sfm
@needs_pycolmap
def test_the_adapter_leaves_compression_intact(tmp_path: Path) -> None:
    # In a fresh process: loaded in the wrong order, pycolmap's own zlib corrupts the heap at the next compression.
    code = (
        "import gsstream.input.seeds._pycolmap, zlib, sys\n"
        "data = bytes(range(256)) * 4096\n"
        "assert zlib.decompress(zlib.compress(data, 9)) == data\n"
        "import numpy as np\n"
        "a = np.random.default_rng(0).integers(0, 9, 200000)\n"
        "np.savez_compressed(sys.argv[1], a=a)\n"
        "assert (np.load(sys.argv[1])['a'] == a).all()\n"
        "print('intact')\n"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "a.npz")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, "intact"), done.stderr


def test_a_native_abort_becomes_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # A stand-in interpreter that aborts, as the library does on faults it cannot report.
    aborting = tmp_path / "python"
    aborting.write_text("#!/bin/sh\necho 'free(): invalid pointer' >&2\nkill -ABRT $$\n")
    aborting.chmod(0o755)
    monkeypatch.setattr(sys, "executable", os.fspath(aborting))
    with pytest.raises(InputError, match=r"was ended by signal 6: .*free\(\): invalid pointer"):
        sfm.run_pycolmap("triangulate", tmp_path, 30)


def test_a_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    source = SyntheticSource.from_query("width=16&height=16&views=3")
    with pytest.raises(InputError, match=r"pip install 'gsstream\[sfm\]'"):
        mapping.triangulate_points(source.frame(0).images, source.info.train)


@pytest.mark.sfm
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system does not choose processors")
def test_the_number_of_processors_changes_no_bit() -> None:
    """Images of different sizes of work finish in another order than they began; the database must not show it."""
    pytest.importorskip("pycolmap")
    from gsstream.input.recordings.open import open_source
    from gsstream.input.seeds.mapping import reconstruct

    images = open_source("synthetic:width=240&height=180&views=5&frames=1&static=true").frame(0).images
    large = [np.kron(images[0], np.ones((3, 3, 1), np.float32)), *images[1:]]  # the first takes longest
    before, found = os.sched_getaffinity(0), []
    try:
        for cores in (before, {min(before)}, before):
            os.sched_setaffinity(0, cores)
            found.append(reconstruct(large, model="PINHOLE", shared=False))
    finally:
        os.sched_setaffinity(0, before)
    for other in found[1:]:
        assert other.xyz.tobytes() == found[0].xyz.tobytes()
        assert other.viewmats.tobytes() == found[0].viewmats.tobytes()
    assert len(found[0].xyz) > 5
