"""Conversions between conventions and lenses: inverses, invariants, and formulas written in another way."""

from __future__ import annotations

import importlib.util
import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_recordings import SIZE, make_world, quaternion, write_colmap, write_enerf

from gsstream.core.errors import SourceError
from gsstream.input.recordings.lens import Lens, from_colmap, undistortion
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
from gsstream.input.recordings.rigs.camera import opencv_lens

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
    st.tuples(st.floats(-0.01, 0.01), st.floats(-0.01, 0.01)).map(
        lambda v: Lens("fisheye", (0.02, -0.01), v, (v[1], 0.0, v[0], 0.0))
    ),
    st.floats(0.01, 1.2).map(lambda angle: Lens("fov", (angle,))),
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


#: COLMAP's parameters, by its names of the models; the focal lengths differ where a model has two.
MODELS: dict[str, tuple[float, ...]] = {
    "SIMPLE_PINHOLE": (40, 24, 16),
    "PINHOLE": (40, 42, 24, 16),
    "SIMPLE_RADIAL": (40, 24, 16, -0.1),
    "RADIAL": (40, 24, 16, -0.1, 0.02),
    "OPENCV": (40, 42, 24, 16, -0.2, 0.05, 0.003, -0.002),
    "FULL_OPENCV": (40, 42, 24, 16, -0.2, 0.05, 0.003, -0.002, 0.01, 0.02, -0.01, 0.003),
    "SIMPLE_FISHEYE": (40, 24, 16),
    "FISHEYE": (40, 42, 24, 16),
    "SIMPLE_RADIAL_FISHEYE": (40, 24, 16, 0.02),
    "RADIAL_FISHEYE": (40, 24, 16, 0.02, -0.01),
    "OPENCV_FISHEYE": (40, 42, 24, 16, 0.02, -0.01, 0.004, -0.001),
    "THIN_PRISM_FISHEYE": (40, 42, 24, 16, 0.02, -0.01, 0.003, -0.002, 0.004, -0.001, 0.005, -0.004),
    "FOV": (40, 42, 24, 16, 0.9),
}
PROJECT = """
import zlib, json, sys, numpy as np, pycolmap
models, points = json.loads(sys.argv[1])
rays = np.concatenate([np.array(points), np.ones((len(points), 1))], 1)
seen = {
    name: np.asarray(pycolmap.Camera(model=name, width=48, height=32, params=params).img_from_cam(rays)).tolist()
    for name, params in models.items()
}
print(json.dumps([seen, list(pycolmap.CameraModelId.__members__)]))
"""


@pytest.mark.sfm
@pytest.mark.skipif(importlib.util.find_spec("pycolmap") is None, reason="pycolmap is not installed")
def test_lenses_bend_as_pycolmap_bends_and_all_others_are_called_unsupported() -> None:
    """In a process of its own, as everything of pycolmap; 1,000 rays up to 60 degrees from the axis, and the axis."""
    points = np.random.default_rng(0).uniform(-1.2, 1.2, (1000, 2))
    points[0] = 0
    command = [sys.executable, "-c", PROJECT, json.dumps([MODELS, points.tolist()])]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr
    seen, every = json.loads(done.stdout)
    for model, params in MODELS.items():
        own, lens = from_colmap(model, params, "here")
        x, y = lens.distort(points[:, 0], points[:, 1])
        pixels = np.stack([own[0, 0] * x + own[0, 2], own[1, 1] * y + own[1, 2]], 1)
        away = np.abs(pixels - seen[model]).max(1)
        # Within 0.01 of the axis, COLMAP takes the first terms of a series for FOV.
        assert (away < np.where((model == "FOV") & (np.hypot(*points.T) < 0.01), 1e-9, 1e-12)).all(), model
    for model in set(every) - set(MODELS) - {"INVALID"}:
        with pytest.raises(SourceError, match=f"the model {model} is not supported"):
            from_colmap(model, (40.0,) * 20, "here")


def test_an_angle_of_fov_that_is_none_is_refused_and_zero_is_a_pinhole() -> None:
    assert from_colmap("FOV", (40, 42, 24, 16, 0), "here")[1].is_identity
    with pytest.raises(SourceError, match=r"here: the angle of the model FOV must be below pi, got 3\.2"):
        from_colmap("FOV", (40, 42, 24, 16, 3.2), "here")


def test_the_prism_of_twelve_coefficients_bends_as_opencv_bends() -> None:
    """Numbers of OpenCV 5.0's projectPoints; 14 coefficients with a tilt are refused."""
    values = [-0.2, 0.05, 0.003, -0.002, 0.01, 0.02, -0.01, 0.003, 0.005, -0.004, 0.002, 0.001]
    points = np.array([[0, 0], [0.5, -0.3], [-0.7, 0.6], [0.1, 0.8]])
    expected = [
        [0, 0],
        [0.4650567690311692, -0.2768839014187015],
        [-0.6083944245693684, 0.5261620067737445],
        [0.08923726684273496, 0.7154906347418796],
    ]
    for more in ([], [0.0, 0.0]):
        lens = opencv_lens([*values, *more], False, "here")
        np.testing.assert_allclose(np.stack(lens.distort(*points.T), 1), expected, atol=1e-15)
    with pytest.raises(SourceError, match="here: expected 0, 4, 5, 8 or 12 coefficients"):
        opencv_lens([*values, 0.01, 0.0], False, "here")


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
