"""Steps of frame 0 on their own: coarse pictures, names of axes, noise of centres, nearest points."""

from __future__ import annotations

import math
import subprocess
import sys
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gsstream.core.cameras import Cameras
from gsstream.core.frame import Frame, shrink_frame
from gsstream.core.gaussians import Gaussians
from gsstream.core.picture_size import bit_price_factor, densify_factor, enlargement, prune_factor
from gsstream.core.shapes import FloatArray
from gsstream.engine.fit.nearest import nearest_rows, neighbour_distance
from gsstream.engine.frame0.axes import nearest_axes
from gsstream.engine.frame0.optimise import FirstFrameRun
from gsstream.engine.frame0.pyramid import keep_widths, one_size, plan_pyramid
from gsstream.parts.backend.reference import ReferenceRenderer
from gsstream.parts.render.activations import rotation_matrices
from gsstream.recipe.model import FirstFrame

SETTINGS = FirstFrame(lr_means=1e-3)


def rig(width: int, height: int) -> Cameras:
    """Two cameras side by side, three units before the origin."""
    viewmats = np.repeat(np.eye(4)[None], 2, 0)
    viewmats[:, 2, 3], viewmats[1, 0, 3] = 3.0, 0.2
    K = np.array([[width, 0, width / 2], [0, width, height / 2], [0, 0, 1.0]])
    return Cameras(("left", "right"), viewmats, np.stack([K, K]), width, height)


@pytest.mark.parametrize(
    ("width", "factors", "iterations"),
    [
        (160, [1], [2000]),
        (320, [1], [2000]),
        (639, [1], [2000]),
        (640, [2, 1], [650, 550]),
        (1279, [2, 1], [650, 550]),
        (1352, [4, 2, 1], [500, 500, 400]),
        (7680, [4, 2, 1], [500, 500, 400]),
    ],
)
def test_levels_halve_down_to_320_pixels_and_take_up_each_other(width: int, factors: list, iterations: list) -> None:
    pyramid = plan_pyramid(width, 2000, SETTINGS)
    assert [level.factor for level in pyramid.levels] == factors
    assert [level.iterations for level in pyramid.levels] == iterations
    assert [level.begin for level in pyramid.levels] == [sum(iterations[:n]) for n in range(len(iterations))]
    assert pyramid.iterations == sum(iterations)


def test_without_coarse_pictures_or_with_hardly_an_iteration_there_is_one_level() -> None:
    plain = one_size(100, SETTINGS)
    assert plan_pyramid(1352, 100, SETTINGS.model_copy(update={"coarse_to_fine": False})) == plain
    assert plan_pyramid(1352, 2, SETTINGS) == one_size(2, SETTINGS)
    assert plan_pyramid(320, 100, SETTINGS) == plain
    (level,) = plain.levels
    # The schedule of 3DGS: log-linear from the first rate to the last.
    assert level.lr_at(50) == pytest.approx(math.sqrt(1e-3 * 1e-5))
    assert level.lr_at(100) == pytest.approx(1e-5)


def test_rates_fall_within_each_level_and_the_finest_begins_above_where_the_last_one_ended() -> None:
    levels = plan_pyramid(1352, 2000, SETTINGS).levels
    assert levels[0].lr_at(0) == pytest.approx(1e-3)
    for level in levels:
        rates = [level.lr_at(iteration) for iteration in range(level.begin + 1, level.end + 1)]
        assert all(later < earlier for earlier, later in pairwise(rates))
    assert levels[2].lr_at(levels[2].begin) > levels[1].lr_at(levels[1].end)
    assert levels[2].lr_at(levels[2].end) == pytest.approx(2e-5)


def test_a_rate_of_zero_stays_zero() -> None:
    (level,) = one_size(10, FirstFrame(lr_means=0)).levels
    assert [level.lr_at(n) for n in (1, 10)] == [0.0, 0.0]


def test_small_pictures_are_means_and_their_cameras_see_the_same() -> None:
    images = np.random.default_rng(0).random((2, 26, 37, 3), np.float32)
    frame = Frame(0, 0.0, images, rig(37, 26))
    small = shrink_frame(frame, 4)
    assert small.images.shape == (2, 6, 9, 3)
    assert small.images.dtype == np.float32
    assert small.images[1, 2, 3] == pytest.approx(images[1, 8:12, 12:16].mean((0, 1)), abs=1e-6)
    assert (small.cameras.width, small.cameras.height) == (9, 6)
    # A pixel's corner (u, v) of the large picture is (u / 4, v / 4) of the small one.
    assert small.cameras.Ks == pytest.approx(np.diag([0.25, 0.25, 1]) @ frame.cameras.Ks)
    assert shrink_frame(frame, 1) is frame


def test_widths_are_kept_when_pictures_become_larger() -> None:
    """What was drawn with large pixels looks the same with small ones, made small again; unchanged it does not."""
    torch.manual_seed(0)
    count = 30
    scene = Gaussians(
        means=torch.randn(count, 3) * 0.3,
        quats=torch.nn.functional.normalize(torch.randn(count, 4), dim=1),
        scales=torch.full((count, 3), math.log(0.01)),
        opacities=torch.full((count,), -1.0),
        sh0=torch.rand(count, 1, 3),
        shN=torch.zeros(count, 0, 3),
    )
    large = rig(96, 64)
    small, renderer = large.scaled(24, 16), ReferenceRenderer()
    wide = replace(scene, scales=keep_widths(scene, large, 4, 1))

    def seen(gaussians: Gaussians[torch.Tensor], cameras: Cameras) -> torch.Tensor:
        return renderer.render(gaussians, cameras, 0, (0.0, 0.0, 0.0)).image

    def shrunk(image: torch.Tensor) -> torch.Tensor:
        return image.reshape(16, 4, 24, 4, 3).mean((1, 3))

    was = seen(scene, small)
    kept, lost = (float((shrunk(seen(g, large)) - was).square().mean()) for g in (wide, scene))
    assert kept < 0.2 * lost
    assert torch.equal(keep_widths(scene, large, 2, 2), 0.5 * torch.log(torch.exp(2 * scene.scales)))


@pytest.mark.parametrize("width", [1, 160, 320])
def test_pictures_of_320_pixels_and_fewer_leave_every_setting_as_it_is(width: int) -> None:
    assert enlargement(width) == densify_factor(width) == prune_factor(width) == bit_price_factor(width * 240) == 1.0


def test_settings_follow_the_width() -> None:
    """Where they were measured to be right: 640 x 360 and 1352 x 1014."""
    assert enlargement(1352) == pytest.approx(4.225)
    assert 3e-4 * densify_factor(676) == pytest.approx(2.1e-4, rel=0.05)
    assert 3e-4 * densify_factor(1352) == pytest.approx(1.2e-4, rel=0.05)
    assert 10 * prune_factor(640) == pytest.approx(5, rel=0.1)
    assert 10 * prune_factor(1352) == pytest.approx(2, rel=0.1)
    assert bit_price_factor(640 * 360) == pytest.approx(2.28, rel=0.01)
    assert bit_price_factor(1352 * 1014) == pytest.approx(8.74, rel=0.01)


def drawn(seed: int, rows: int = 200) -> Gaussians[torch.Tensor]:
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(rows, 4)) * 10 ** rng.uniform(-3, 3, (rows, 1))
    return Gaussians(
        means=torch.zeros(rows, 3),
        quats=torch.from_numpy(quats).float(),
        scales=torch.from_numpy(rng.normal(-3, 2, (rows, 3))).float(),
        opacities=torch.zeros(rows),
        sh0=torch.zeros(rows, 1, 3),
        shN=torch.zeros(rows, 0, 3),
    )


def covariances(gaussians: Gaussians[torch.Tensor]) -> torch.Tensor:
    """[N, 3, 3] of the ellipsoids, of unit quaternions."""
    quats = gaussians.quats.double()
    turns = rotation_matrices(quats / quats.norm(dim=1, keepdim=True))
    return turns @ torch.diag_embed((2 * gaussians.scales.double()).exp()) @ turns.transpose(1, 2)


@given(st.integers(0, 10_000))
def test_the_ellipsoid_stays_and_the_first_component_is_large(seed: int) -> None:
    before = drawn(seed)
    after = nearest_axes(before)
    one, other = covariances(before), covariances(after)
    assert float(((one - other).abs().amax((1, 2)) / one.abs().amax((1, 2))).max()) < 1e-6
    assert float(after.quats.norm(dim=1).sub(1).abs().max()) < 1e-6
    # The farthest rotation from all 24 is 62.8 degrees away: half of it has a cosine of 0.8536.
    assert float(after.quats[:, 0].min()) >= 0.853
    assert torch.equal(after.scales.sort(1).values, before.scales.sort(1).values)


@given(st.integers(0, 10_000))
def test_all_names_of_one_ellipsoid_become_one_and_again_changes_nothing(seed: int) -> None:
    first = nearest_axes(drawn(seed, 20))
    again = nearest_axes(first)
    assert torch.allclose(first.quats, again.quats, atol=1e-6)
    assert torch.equal(first.scales, again.scales)


@pytest.mark.parametrize(
    "quat", [[1, 0, 0, 0], [0, 1, 0, 0], [0.5, -0.5, 0.5, -0.5], [0, 0, -0.70710677, 0.70710677], [-2, 0, 0, 0]]
)
def test_a_rotation_of_axes_to_axes_only_moves_scales(quat: list[float]) -> None:
    start = drawn(0, 1)
    turned = nearest_axes(Gaussians(**{**dict(start.items()), "quats": torch.tensor([quat], dtype=torch.float32)}))
    assert torch.allclose(turned.quats, torch.tensor([[1.0, 0, 0, 0]]), atol=1e-6)


def test_no_rows() -> None:
    assert len(nearest_axes(drawn(0, 0))) == 0


NUMBER = 20_000


def disturbed(noise: float, seed: int = 0) -> tuple[Gaussians[torch.Tensor], Gaussians[torch.Tensor]]:
    rows = Gaussians(
        means=torch.zeros(NUMBER, 3, requires_grad=True),
        quats=torch.ones(NUMBER, 4),
        scales=torch.zeros(NUMBER, 3),
        opacities=torch.zeros(NUMBER),
        sh0=torch.zeros(NUMBER, 1, 3),
        shN=torch.zeros(NUMBER, 0, 3),
    )
    run = object.__new__(FirstFrameRun)
    run.settings, run.extent = FirstFrame(noise=noise), 2.0
    run.generator = torch.Generator().manual_seed(seed)
    return rows, run._disturbed(rows)


def test_noise_has_the_size_that_is_asked_for_and_gradients_pass() -> None:
    rows, noisy = disturbed(0.01)
    moved = noisy.means.detach()
    assert moved.std(0).numpy() == pytest.approx(0.02, rel=0.03), "a hundredth of an extent of two units"
    assert abs(float(moved.mean())) < 3 * 0.02 / (3 * NUMBER) ** 0.5 + 1e-4
    (3 * noisy.means).sum().backward()
    assert torch.equal(rows.means.grad, torch.full((NUMBER, 3), 3.0))
    for name in ("quats", "scales", "opacities", "sh0", "shN"):
        assert getattr(noisy, name) is getattr(rows, name)


def test_noise_is_that_of_the_seed_and_none_without() -> None:
    assert torch.equal(disturbed(0.01)[1].means, disturbed(0.01)[1].means)
    assert not torch.equal(disturbed(0.01)[1].means, disturbed(0.01, seed=1)[1].means)
    rows, same = disturbed(0.0)
    assert same is rows


KINDS = ("ball", "plane", "line", "grid", "pairs", "aside", "far")


def cloud(kind: str, count: int, seed: int) -> FloatArray:
    rng = np.random.default_rng(seed)
    xyz = rng.normal(size=(count, 3))
    if kind == "plane":
        xyz[:, 2] = 0
    elif kind == "line":
        xyz[:, 1:] = 3
    elif kind == "grid":
        xyz = xyz.round()
    elif kind == "pairs":
        xyz[1::2] = xyz[: count // 2 * 2 : 2]
    elif kind == "aside":
        xyz = xyz * 0.1 + 100  # where a table made by a product of matrices has no distances left
    elif kind == "far":
        xyz = xyz * 100 + 1e7
    return xyz.astype(np.float32)


def table(points: FloatArray, among: FloatArray) -> FloatArray:
    difference = points.astype(np.float64)[:, None] - among.astype(np.float64)[None]
    distances: FloatArray = np.linalg.norm(difference, axis=2)
    return distances


@given(kind=st.sampled_from(KINDS), count=st.integers(2, 60), seed=st.integers(0, 99))
def test_the_spacing_is_that_of_the_three_nearest_others(kind: str, count: int, seed: int) -> None:
    xyz = cloud(kind, count, seed)
    nearest = np.sort(table(xyz, xyz), axis=1)[:, 1:4]
    expected = np.sqrt(np.square(nearest).mean(1))
    found = neighbour_distance(torch.from_numpy(xyz))
    assert found.dtype == torch.float32
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-6)


@given(kind=st.sampled_from(KINDS), count=st.integers(1, 60), asked=st.integers(0, 20), seed=st.integers(0, 99))
def test_the_nearest_row_is_the_nearest(kind: str, count: int, asked: int, seed: int) -> None:
    means, points = cloud(kind, count, seed), cloud(kind, asked, seed + 1)
    distances, rows = nearest_rows(points, means)
    expected = table(points, means)
    np.testing.assert_allclose(distances, expected.min(1), rtol=1e-6)
    np.testing.assert_array_equal(expected[np.arange(asked), rows], expected.min(1))


@pytest.mark.parametrize("count", [0, 1])
def test_a_point_alone_has_a_size(count: int) -> None:
    found = neighbour_distance(torch.zeros(count, 3))
    assert found.shape == (count,)
    assert (found > 0).all()


def test_nothing_is_infinitely_far_from_everything() -> None:
    distances, rows = nearest_rows(np.zeros((3, 3), np.float32), np.zeros((0, 3), np.float32))
    assert np.isinf(distances).all()
    assert rows.shape == (3,)


def test_memory_follows_the_cloud_and_not_its_square() -> None:
    """A table of all distances, block by block, once left every block on the heap: 12 GB for 60,000 points."""
    code = """
import resource, torch
from gsstream.engine.fit.nearest import neighbour_distance
peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
neighbour_distance(torch.rand(100, 3))
before = peak()
neighbour_distance(torch.rand(60_000, 3))
print(peak() - before)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert float(done.stdout) < 100, "megabytes; the positions themselves are 0.7"
