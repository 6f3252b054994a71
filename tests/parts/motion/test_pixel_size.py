"""The unit of motions, against the formula written out."""

from __future__ import annotations

import numpy as np
import pytest

from gsstream.core.cameras import Cameras
from gsstream.core.picture_size import enlargement
from gsstream.parts.motion.groups import pixel_size


def test_it_is_the_median_over_cameras_and_gaussians_of_distance_over_focal_length() -> None:
    rng = np.random.default_rng(3)
    means = rng.normal(size=(101, 3)).astype(np.float32)
    viewmats = np.tile(np.eye(4), (4, 1, 1))
    viewmats[:, :3, 3] = rng.normal(size=(4, 3)) * 5
    Ks = np.tile(np.eye(3), (4, 1, 1))
    Ks[:, 0, 0] = Ks[:, 1, 1] = [50.0, 60.0, 70.0, 80.0]
    cameras = Cameras(tuple("abcd"), viewmats, Ks, 32, 24)
    widths = [
        np.linalg.norm(means - at, axis=1) / K[0, 0] for at, K in zip(cameras.centers, cameras.Ks, strict=True)
    ]
    # To the bit: a step of motions is made of it, and a stream's bytes with it.
    assert pixel_size(means, cameras) == float(np.median(np.concatenate(widths)))


@pytest.mark.parametrize("times", [1, 2, 4.225])
def test_lengths_in_pixels_mean_the_same_in_the_scene_at_every_size_of_picture(times: float) -> None:
    """Sides of groups and longest steps are some pixels times both, so a recipe fits the same recording at any size."""
    means = np.random.default_rng(3).normal(size=(50, 3)).astype(np.float32)
    viewmats = np.tile(np.eye(4), (2, 1, 1))
    viewmats[:, 2, 3] = 7.0
    K = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
    small = Cameras(("a", "b"), viewmats, np.stack([K, K]), 320, 240)
    large = small.scaled(round(320 * times), round(240 * times))
    length = pixel_size(means, large) * enlargement(large.width)
    assert length == pytest.approx(pixel_size(means, small), rel=1e-12)
