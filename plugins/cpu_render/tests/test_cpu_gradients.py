"""Image and gradients against float64 autograd, for every instruction set of this machine."""

from __future__ import annotations

import numpy as np
import pytest
from cpu_scenes import (
    GRADIENT_TOLERANCE,
    as_splats,
    random_splats,
    rasterizer,
    reference,
    relative_error,
    upstream,
)
from gsstream_cpu_render.arrays import SplatArrays


def assert_as_reference(
    splats: SplatArrays, seed: int = 0, focal: float = 50.0, tolerance: float = GRADIENT_TOLERANCE
) -> None:
    v_image, v_alpha = upstream(seed)
    want_image, want_transmittance, want = reference(splats, v_image, v_alpha, focal)
    subject = rasterizer(focal=focal)
    image, transmittance = subject.forward(splats)
    gradients = subject.backward(v_image, v_alpha)
    assert np.abs(image - want_image).max() < 2e-5
    assert np.abs(transmittance - want_transmittance).max() < 2e-5
    errors = {name: relative_error(g, w) for name, g, w in zip(want._fields, gradients, want, strict=True)}
    assert max(errors.values()) <= tolerance, errors


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
@pytest.mark.parametrize(("n", "seed", "opaque"), [(40, 0, False), (130, 1, True), (200, 2, False)])
def test_random_scenes(isa: str, coefficients: int, n: int, seed: int, opaque: bool) -> None:
    assert_as_reference(random_splats(n, seed, coefficients, opaque), seed)


def test_wide_angle_clamps_the_jacobian(isa: str) -> None:
    # A short focal length and centres far off axis: many Jacobians are limited to 1.3 fields of view.
    splats = random_splats(120, 3, 9)
    splats.means[:, :2] *= 3
    splats.scales[:] += 1.0
    assert_as_reference(splats, 3, focal=30.0)


def test_gaussians_behind_and_beside_the_camera(isa: str) -> None:
    splats = random_splats(150, 4, 4)
    splats.means[:] *= 4
    splats.means[:20] = splats.means[:20] * 0.01 + np.array([0.0, 0.0, -3.0], np.float32)  # around the camera centre
    assert_as_reference(splats, 4)


def test_saturated_alpha_has_no_geometric_gradient(isa: str) -> None:
    splats = random_splats(60, 5, 4)
    splats.opacities[::2] = 12.0  # alpha is cut at 0.999 near the centres
    splats.scales[::2] += 1.0
    assert_as_reference(splats, 5)


def test_long_thin_gaussians(isa: str) -> None:
    # Determinants of such covariances cancel in float32 unless they are computed as a sum of squares. The looser bound
    # is for the second moments of the pixels, of which a thin Gaussian's small eigenvalue is a 200th part.
    splats = random_splats(40, 6, 1)
    splats.scales[:] = np.log([0.5, 0.002, 0.002])
    assert_as_reference(splats, 6, tolerance=2e-3)


@pytest.mark.parametrize("logit", [-40.0, 40.0])
def test_extreme_opacities(isa: str, logit: float) -> None:
    splats = random_splats(30, 7, 4)
    splats.opacities[::3] = logit
    assert_as_reference(splats, 7)


@pytest.mark.parametrize("n", [0, 1])
@pytest.mark.parametrize("coefficients", [1, 16])
def test_empty_and_single(isa: str, n: int, coefficients: int) -> None:
    assert_as_reference(random_splats(n, 8, coefficients))


def test_all_behind(isa: str) -> None:
    splats = random_splats(25, 9, 4)
    splats.means[:, 2] -= 50
    assert_as_reference(splats)


def test_depth_ties_keep_memory_order(isa: str) -> None:
    one = random_splats(1, 10, 1)
    splats = as_splats(*(np.repeat(a, 40, 0) for a in one))
    splats.sh0[:] = np.random.default_rng(0).normal(size=splats.sh0.shape)
    splats.opacities[:] = -1.0
    assert_as_reference(splats)
