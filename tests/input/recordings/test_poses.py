"""Conversions between conventions and lenses: inverses, invariants, and formulas written in another way."""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import SIZE, make_world, quaternion, write_colmap, write_enerf

from gsstream.input.recordings.lens import Lens, undistortion
from gsstream.input.recordings.open import open_source
from gsstream.input.recordings.poses import (
    OPENGL_TO_OPENCV,
    from_llff,
    from_opengl,
    from_pixel_centers,
    from_quaternion,
    from_rotation_vector,
    invert,
)

K = np.array([[40.0, 0, 24], [0, 42.0, 16], [0, 0, 1]])
angles = st.floats(-3.1, 3.1)
vectors = st.tuples(angles, angles, angles).map(np.array)


def pose_of(vector: np.ndarray, center: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = from_rotation_vector(vector), center
    return pose


@given(vectors)
@settings(max_examples=60, deadline=None)
def test_rotation_vectors_and_quaternions_are_rotations_and_agree(vector: np.ndarray) -> None:
    rotation = from_rotation_vector(vector)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    angle = np.linalg.norm(vector)
    np.testing.assert_allclose(rotation @ vector, vector, atol=1e-9)  # the axis stays
    assert np.trace(rotation) == pytest.approx(1 + 2 * math.cos(angle), abs=1e-9)
    np.testing.assert_allclose(from_rotation_vector(-vector), rotation.T, atol=1e-12)
    again = from_quaternion(3.0 * quaternion(rotation), np.zeros(3))
    np.testing.assert_allclose(again[:3, :3], rotation, atol=1e-7)
    if angle > 1e-3:
        axis = vector / angle
        direct = np.array([math.cos(angle / 2), *(axis * math.sin(angle / 2))])
        np.testing.assert_allclose(from_quaternion(direct, np.ones(3))[:3, :3], rotation, atol=1e-12)


@given(vectors, vectors)
@settings(max_examples=40, deadline=None)
def test_inverses_undo_and_conventions_keep_the_centre(vector: np.ndarray, center: np.ndarray) -> None:
    pose = pose_of(vector, center)
    np.testing.assert_allclose(invert(pose) @ pose, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(OPENGL_TO_OPENCV @ OPENGL_TO_OPENCV, np.eye(4))
    view = from_opengl(pose)
    np.testing.assert_allclose((view @ [*center, 1])[:3], 0, atol=1e-12)
    # One unit before an OpenGL camera is at its -z; one to its right +x; one above it +y, which is down for us.
    for steps, expected in (((0, 0, -1), (0, 0, 1)), ((1, 0, 0), (1, 0, 0)), ((0, 1, 0), (0, -1, 0))):
        np.testing.assert_allclose((view @ pose @ [*steps, 1])[:3], expected, atol=1e-12)


@given(vectors, vectors)
@settings(max_examples=40, deadline=None)
def test_llff_rows_name_their_axes(vector: np.ndarray, center: np.ndarray) -> None:
    down, right, back = from_rotation_vector(vector).T
    view = from_llff(np.stack([down, right, back, center], 1)[None])[0]
    if np.linalg.det(np.stack([right, down, -back])) < 0:
        return  # columns of a right-handed camera only
    for axis, expected in ((right, (1, 0, 0)), (down, (0, 1, 0)), (-back, (0, 0, 1))):
        np.testing.assert_allclose((view @ [*(center + axis), 1])[:3], expected, atol=1e-9)


def test_pixel_centres_move_by_half_a_pixel_and_leave_their_input() -> None:
    before = K.copy()
    after = from_pixel_centers(K)
    np.testing.assert_array_equal(after - before, [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    np.testing.assert_array_equal(K, before)


lenses = st.one_of(
    st.tuples(st.floats(-0.25, 0.2), st.floats(-0.05, 0.05), st.floats(-0.01, 0.01), st.floats(-0.01, 0.01)).map(
        lambda v: Lens("radial", v[:2], v[2:])
    ),
    st.tuples(st.floats(-0.05, 0.05), st.floats(-0.02, 0.02)).map(lambda v: Lens("fisheye", (*v, 0.0, 0.0))),
)


@given(lenses)
@settings(max_examples=60, deadline=None)
def test_the_pinhole_image_is_full_and_as_wide_as_possible(lens: Lens) -> None:
    pinhole = undistortion(lens, K, SIZE, target=SIZE, where="here").K
    np.testing.assert_array_equal(pinhole[:2, 2], K[:2, 2])
    u, v = np.meshgrid(np.linspace(0, SIZE[0], 33), np.linspace(0, SIZE[1], 23))

    def inside(focal: np.ndarray, margin: float) -> bool:
        x, y = lens.distort((u - K[0, 2]) / focal[0, 0], (v - K[1, 2]) / focal[1, 1])
        x, y = K[0, 0] * x + K[0, 2], K[1, 1] * y + K[1, 2]
        return bool(((x >= -margin) & (x <= SIZE[0] + margin) & (y >= -margin) & (y <= SIZE[1] + margin)).all())

    assert inside(pinhole, 0.02)
    wider = pinhole.copy()
    wider[[0, 1], [0, 1]] *= 0.98
    assert not inside(wider, -0.02)


@given(lenses)
@settings(max_examples=20, deadline=None)
def test_a_smooth_picture_is_found_where_the_lens_put_it(lens: Lens) -> None:
    """A picture of the ray direction itself: undistorted, every pixel must hold its own pinhole direction."""
    size = (96, 64)
    calibration = np.diag([2.0, 2.0, 1.0]) @ K
    fine_u, fine_v = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    # Invert the lens by Newton-free iteration: x <- x + (target - distort(x)).
    at_x, at_y = (fine_u - calibration[0, 2]) / calibration[0, 0], (fine_v - calibration[1, 2]) / calibration[1, 1]
    x, y = at_x.copy(), at_y.copy()
    for _ in range(200):
        bent_x, bent_y = lens.distort(x, y)
        x, y = x + 0.7 * (at_x - bent_x), y + 0.7 * (at_y - bent_y)
    if np.abs(np.stack(lens.distort(x, y)) - np.stack([at_x, at_y])).max() > 1e-6:
        return  # the corner lies where this lens has no inverse; the pinhole image does not reach it
    recorded = np.stack([x, y, np.zeros_like(x)], -1).astype(np.float32)
    made = undistortion(lens, calibration, size, target=size, where="here")
    pinhole, flat = made.K, made.apply(recorded)
    np.testing.assert_allclose(flat[1:-1, 1:-1, 0], ((fine_u - pinhole[0, 2]) / pinhole[0, 0])[1:-1, 1:-1], atol=2e-3)
    np.testing.assert_allclose(flat[1:-1, 1:-1, 1], ((fine_v - pinhole[1, 2]) / pinhole[1, 1])[1:-1, 1:-1], atol=2e-3)


@pytest.mark.sfm
@pytest.mark.skipif(importlib.util.find_spec("pycolmap") is None, reason="pycolmap is not installed")
@pytest.mark.parametrize(
    ("model", "lens"),
    [
        ("OPENCV", Lens("radial", (-0.2, 0.05), (0.003, -0.002))),
        ("FULL_OPENCV", Lens("radial", (-0.2, 0.05, 0.01, 0.02, -0.01, 0.003), (0.003, -0.002))),
        ("OPENCV_FISHEYE", Lens("fisheye", (0.02, -0.01, 0.004, -0.001))),
        ("RADIAL", Lens("radial", (-0.1, 0.02))),
    ],
)
def test_lenses_bend_as_pycolmap_bends(model: str, lens: Lens) -> None:
    """In a process of its own, as everything of pycolmap."""
    import json
    import subprocess
    import sys

    params = {
        "OPENCV": [40, 42, 24, 16, *lens.k[:2], *lens.p],
        "FULL_OPENCV": [40, 42, 24, 16, *lens.k[:2], *lens.p, *lens.k[2:]],
        "OPENCV_FISHEYE": [40, 42, 24, 16, *lens.k],
        "RADIAL": [40, 24, 16, *lens.k],
    }[model]
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (30, 2))
    code = (
        "import zlib, json, sys, numpy as np, pycolmap\n"
        "model, params, points = json.loads(sys.argv[1])\n"
        "c = pycolmap.Camera(model=model, width=48, height=32, params=params)\n"
        "rays = np.concatenate([np.array(points), np.ones((len(points), 1))], 1)\n"
        "print(json.dumps(np.asarray(c.img_from_cam(rays)).tolist()))\n"
    )
    command = [sys.executable, "-c", code, json.dumps([model, params, points.tolist()])]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr
    x, y = lens.distort(points[:, 0], points[:, 1])
    fy = 40 if model == "RADIAL" else 42
    np.testing.assert_allclose(np.stack([40 * x + 24, fy * y + 16], 1), json.loads(done.stdout), atol=1e-9)


def test_readers_deliver_pinhole_cameras_for_distorted_ones(tmp_path: Path) -> None:
    """A mild lens: the delivered camera is narrower or wider than the stored one, and the picture is resampled."""
    world = make_world(frames=1)
    bent = np.array([-0.15, 0.02, 0.001, -0.001, 0.0])
    source = open_source(str(write_enerf(tmp_path / "enerf", world, distortion=bent)))
    lens = Lens("radial", (-0.15, 0.02, 0.0), (0.001, -0.001))
    for i, K_stored in enumerate(world.Ks[1:]):
        made = undistortion(lens, K_stored, SIZE, target=SIZE, where="here")
        expected = made.K
        np.testing.assert_allclose(source.info.train.Ks[i], expected, atol=1e-9)
        assert expected[0, 0] != K_stored[0, 0]
        picture = (world.pictures[0, i + 1] / 255).astype(np.float32)
        flat = made.apply(picture)
        np.testing.assert_allclose(source.frame(0).images[i], flat, atol=0.51 / 255)
        assert source.stored_image(0, source.info.train.ids[i]).dtype == np.uint8, (
            "it has the levels that it is made of"
        )
    half = open_source(str(tmp_path / "enerf"), 0.5)
    np.testing.assert_allclose(half.info.train.Ks[:, :2] * 2, source.info.train.Ks[:, :2])
    lens_of_colmap = {"model": "OPENCV", "extra": (-0.15, 0.02, 0.001, -0.001)}
    again = open_source(str(write_colmap(tmp_path / "colmap", world, frames="images", **lens_of_colmap)))
    np.testing.assert_allclose(again.frame(0).images[1:], source.frame(0).images, atol=1.01 / 255)
