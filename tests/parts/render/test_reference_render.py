"""The renderer that defines the truth, against closed forms, an independent projection and finite differences."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch

from gsstream.core.cameras import Cameras
from gsstream.core.gaussians import ATTRIBUTES, Gaussians
from gsstream.parts.backend.base import Renderer
from gsstream.parts.backend.reference import ReferenceRenderer, evaluate_sh, project

F, W, H = 20.0, 14, 10
BLACK, WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
C0 = 0.28209479177387814


def camera(rotation: np.ndarray | None = None, translation: tuple[float, float, float] = (0, 0, 0)) -> Cameras:
    viewmat = np.eye(4)
    viewmat[:3, :3] = np.eye(3) if rotation is None else rotation
    viewmat[:3, 3] = translation
    K = np.array([[F, 0, W / 2], [0, F * 1.1, H / 2], [0, 0, 1]])
    return Cameras(("cam",), viewmat[None], K[None], W, H)


def scene(
    means: list[list[float]], opacity: float = 0.6, sigma: float = 0.2, rgb: list[list[float]] | None = None
) -> Gaussians[torch.Tensor]:
    n = len(means)
    colors = torch.tensor(rgb if rgb is not None else [[0.9, 0.5, 0.2]] * n, dtype=torch.float64).reshape(n, 3)
    quats = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64).repeat(n, 1)
    return Gaussians(
        means=torch.tensor(means, dtype=torch.float64).reshape(n, 3),
        quats=quats,
        scales=torch.full((n, 3), math.log(sigma), dtype=torch.float64),
        opacities=torch.full((n,), math.log(opacity / (1 - opacity)), dtype=torch.float64),
        sh0=((colors - 0.5) / C0)[:, None],
        shN=torch.zeros(n, 0, 3, dtype=torch.float64),
    )


def random_scene(n: int, bases: int = 9, seed: int = 0, dtype: torch.dtype = torch.float64) -> Gaussians[torch.Tensor]:
    g = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    return Gaussians(
        means=normal(n, 3) * 0.3 + torch.tensor([0, 0, 2.0]),
        quats=normal(n, 4),
        scales=normal(n, 3) * 0.2 - 0.3,
        opacities=normal(n) * 0.5,
        sh0=normal(n, 1, 3) * 0.3,
        shN=normal(n, bases - 1, 3) * 0.1,
    ).map(lambda a: a.to(dtype))


def render(gaussians: Gaussians[torch.Tensor], cameras: Cameras | None = None, background=BLACK, **config: int):
    renderer = ReferenceRenderer(ReferenceRenderer.Config(**config))
    return renderer.render(gaussians, camera() if cameras is None else cameras, 0, background)


def test_one_gaussian_on_the_axis_is_a_closed_form() -> None:
    z, sigma, opacity = 2.0, 0.2, 0.6
    out = render(scene([[0, 0, z]], opacity, sigma))
    xs, ys = np.meshgrid(np.arange(W) + 0.5 - W / 2, np.arange(H) + 0.5 - H / 2)
    var_x, var_y = (F * sigma / z) ** 2 + 0.3, (1.1 * F * sigma / z) ** 2 + 0.3
    alpha = opacity * np.exp(-0.5 * (xs**2 / var_x + ys**2 / var_y))
    alpha[alpha < 1 / 255] = 0
    np.testing.assert_allclose(out.alpha.numpy(), alpha, atol=1e-12)
    np.testing.assert_allclose(out.image.numpy(), alpha[..., None] * [0.9, 0.5, 0.2], atol=1e-12)


def test_projection_against_a_numerical_jacobian() -> None:
    """Independent of the analytic Jacobian: differentiate the pinhole by central differences in numpy."""
    g = np.random.default_rng(0)
    q, _ = np.linalg.qr(g.normal(size=(3, 3)))
    rotation = q * np.linalg.det(q)
    cameras = camera(rotation, (0.1, -0.2, 1.5))
    gaussians = random_scene(5, seed=3)
    to_world = rotation.T @ (np.array([[0.2, 0.1, 2.5]]).T - cameras.viewmats[0, :3, 3:])
    gaussians = dataclasses.replace(gaussians, means=torch.tensor(to_world.T + 0.1 * g.normal(size=(5, 3))))
    means2d, conics, *_ = project(gaussians, cameras, 0)

    def pinhole(x: np.ndarray) -> np.ndarray:
        p = rotation @ x + cameras.viewmats[0, :3, 3]
        return (cameras.Ks[0] @ p / p[2])[:2]

    for i in range(5):
        mean = gaussians.means[i].numpy()
        jacobian = np.stack([(pinhole(mean + e) - pinhole(mean - e)) / 2e-6 for e in 1e-6 * np.eye(3)], 1)
        w, x, y, z = (gaussians.quats[i] / gaussians.quats[i].norm()).numpy()
        turned = np.array(
            [  # columns: q e_k q*, from the quaternion product
                [w * w + x * x - y * y - z * z, 2 * (x * y + w * z), 2 * (x * z - w * y)],
                [2 * (x * y - w * z), w * w - x * x + y * y - z * z, 2 * (y * z + w * x)],
                [2 * (x * z + w * y), 2 * (y * z - w * x), w * w - x * x - y * y + z * z],
            ]
        ).T
        covariance = turned @ np.diag(np.exp(2 * gaussians.scales[i].numpy())) @ turned.T
        expected = jacobian @ covariance @ jacobian.T + 0.3 * np.eye(2)
        np.testing.assert_allclose(means2d[i].numpy(), pinhole(mean), rtol=1e-10)
        np.testing.assert_allclose(np.linalg.inv(conics[i].numpy()), expected, rtol=1e-6)


@pytest.mark.parametrize("attribute", ATTRIBUTES)
def test_gradient_equals_finite_differences(attribute: str) -> None:
    gaussians = random_scene(3)
    weights = torch.randn(H, W, 3, generator=torch.Generator().manual_seed(9), dtype=torch.float64)

    def loss(value: torch.Tensor) -> torch.Tensor:
        out = render(dataclasses.replace(gaussians, **{attribute: value}), background=(0.2, 0.4, 0.6))
        return (out.image * weights).sum() + out.alpha.square().sum()

    value = getattr(gaussians, attribute).clone().requires_grad_()
    assert torch.autograd.gradcheck(loss, value, eps=1e-6, atol=1e-6, rtol=1e-5)


def test_the_session_knows_the_gradient_of_the_2d_means() -> None:
    """Of the rows that may change, on any background: frame 0 grows by it, and so do methods that add Gaussians."""
    gaussians, cameras, active = random_scene(4), camera(), torch.tensor([1, 3])
    session = ReferenceRenderer().open(gaussians, None, cameras, (0.2, 0.4, 0.6)).commit(gaussians, active)
    session.narrow(active)
    weights = torch.randn(H, W, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)

    def loss(probe: torch.Tensor) -> torch.Tensor:
        return (session.render(0, gaussians.rows(active), probe=probe).image * weights).sum()

    probe = torch.zeros(2, 2, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(loss, probe, eps=1e-6, atol=1e-6, rtol=1e-5)
    assert float(loss(probe.detach())) == float((session.render(0, gaussians.rows(active)).image * weights).sum())


def test_screen_gradient_is_the_derivative_of_moving_the_projection() -> None:
    """Moving the principal point moves every projected centre by the same amount."""
    gaussians, cameras = random_scene(4), camera()
    upstream = torch.randn(H, W, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    found = ReferenceRenderer().screen_gradient(gaussians, cameras, 0, upstream)
    assert found.visible.all()
    assert not found.gradient.requires_grad
    eps = 1e-5
    for axis in (0, 1):
        values = []
        for sign in (1, -1):
            shifted = cameras.Ks.copy()
            shifted[0, axis, 2] += sign * eps
            out = render(gaussians, dataclasses.replace(cameras, Ks=shifted))
            values.append(float((out.image * upstream).sum()))
        assert float(found.gradient[:, axis].sum()) == pytest.approx((values[0] - values[1]) / (2 * eps), rel=1e-5)


def test_visible_does_not_depend_on_the_upstream_gradient() -> None:
    means = [[0, 0, 2.0], [0, 0, -2.0], [50.0, 0, 2.0], [0, 40.0, 2.0], [0, 0, 0.005]]
    gaussians = scene(means)
    found = ReferenceRenderer().screen_gradient(gaussians, camera(), 0, torch.zeros(H, W, 3, dtype=torch.float64))
    assert found.visible.tolist() == [True, False, False, False, False]
    assert not found.gradient.any()
    faint = scene([[0, 0, 2.0]], opacity=0.003)  # below 1/255 everywhere
    upstream = torch.ones(H, W, 3, dtype=torch.float64)
    assert ReferenceRenderer().screen_gradient(faint, camera(), 0, upstream).visible.tolist() == [False]


def test_what_leaves_a_trace_is_visible() -> None:
    """The conservative box may only err on the generous side."""
    g = torch.Generator().manual_seed(5)
    gaussians = random_scene(60, seed=6)
    spread = (torch.rand(60, 3, generator=g, dtype=torch.float64) - 0.5) * torch.tensor([3.0, 3.0, 6.0])
    gaussians = dataclasses.replace(gaussians, means=spread + torch.tensor([0, 0, 1.5]), scales=gaussians.scales - 2)
    visible = ReferenceRenderer().screen_gradient(gaussians, camera(), 0, torch.ones(H, W, 3).double()).visible
    traces = torch.stack([render(gaussians.rows(slice(i, i + 1))).alpha.amax() > 0 for i in range(60)])
    assert bool((visible | ~traces).all())
    assert 3 < int(traces.sum()) < 57
    assert int(visible.sum()) <= int(traces.sum()) + 10


def test_a_renderer_without_any_screen_gradient_says_so() -> None:
    class Draws(Renderer):
        def render(self, gaussians, cameras, view, background):  # type: ignore[no-untyped-def]
            return ReferenceRenderer().render(gaussians, cameras, view, background)

    session = Draws().open(scene([[0, 0, 2.0]]), None, camera(), BLACK)
    assert session.visible(0, torch.ones(1, 1, dtype=torch.bool)).tolist() == [True]
    with pytest.raises(NotImplementedError, match="Draws: expected 'screen_gradient'"):
        session.screen_gradient(0, torch.ones(H, W, 3))


def test_visible_is_whose_colour_matters_in_the_marked_tiles() -> None:
    """Held against painting each row another colour: only who is drawn changes a pixel."""
    wide = dataclasses.replace(camera(), width=40, height=24)
    g = torch.Generator().manual_seed(7)
    spread = torch.rand(40, 3, generator=g, dtype=torch.float64) * torch.tensor([3.0, 2.5, 3.0])
    base = random_scene(40, seed=8)
    gaussians = dataclasses.replace(base, means=spread + torch.tensor([-0.5, -0.5, 0.5]), scales=base.scales - 1)
    gaussians = dataclasses.replace(gaussians, opacities=gaussians.opacities + 4)
    session = ReferenceRenderer().open(gaussians, None, wide, BLACK)
    still = ReferenceRenderer().render(gaussians, wide, 0, BLACK).image
    changes = []
    for row in range(40):
        sh0 = gaussians.sh0.clone()
        sh0[row] += 5.0
        painted = ReferenceRenderer().render(dataclasses.replace(gaussians, sh0=sh0), wide, 0, BLACK).image
        changes.append((painted != still).any(2))
    counts = []
    for tile in range(6):
        tiles = (torch.arange(6) == tile).reshape(2, 3)
        y, x = 16 * (tile // 3), 16 * (tile % 3)
        expected = torch.stack([change[y : y + 16, x : x + 16].any() for change in changes])
        assert session.visible(0, tiles).tolist() == expected.tolist()
        counts.append(int(expected.sum()))
    assert max(counts) > 3
    assert min(counts) < 40


def test_the_nearer_one_covers_whatever_the_order_of_rows() -> None:
    near, far = [0, 0, 1.5], [0, 0, 3.0]
    red, blue = [1.0, 0, 0], [0, 0, 1.0]
    a = render(scene([near, far], 0.9, 0.3, [red, blue])).image
    b = render(scene([far, near], 0.9, 0.3, [blue, red])).image
    assert torch.equal(a, b)
    center = a[H // 2, W // 2]
    assert center[0] > 5 * center[2] > 0


def test_ties_in_depth_keep_the_order_of_rows() -> None:
    out = render(scene([[0, 0, 2.0], [0, 0, 2.0]], 0.9, 0.5, [[1.0, 0, 0], [0, 0, 1.0]])).image
    assert out[H // 2, W // 2, 0] > out[H // 2, W // 2, 2]


def test_alpha_is_clamped_and_background_shows_through() -> None:
    out = render(scene([[0, 0, 2.0]], 1 - 1e-9, 50.0, [[0.0, 0, 0]]), background=WHITE)
    np.testing.assert_allclose(out.image.numpy(), 0.001, rtol=1e-6)
    np.testing.assert_allclose(out.alpha.numpy(), 0.999, rtol=1e-9)


def test_background_is_what_alpha_leaves() -> None:
    gaussians = random_scene(6)
    black, grey = render(gaussians), render(gaussians, background=(0.2, 0.5, 0.9))
    expected = black.image + (1 - black.alpha)[..., None] * torch.tensor([0.2, 0.5, 0.9], dtype=torch.float64)
    torch.testing.assert_close(grey.image, expected)


def test_nothing_counts_after_the_light_is_used_up() -> None:
    """0.001^2 < 1e-4: the third opaque layer is not composited, so its colour cannot matter."""
    layers = [[0, 0, 1.0], [0, 0, 2.0], [0, 0, 3.0]]
    rgb = [[0.0, 0, 0]] * 2
    dark = render(scene(layers, 1 - 1e-9, 50.0, [*rgb, [0.0, 0, 0]])).image
    bright = render(scene(layers, 1 - 1e-9, 50.0, [*rgb, [1.0, 1, 1]])).image
    assert torch.equal(dark, bright)


@pytest.mark.parametrize("z", [-2.0, 0.0, 0.01, 0.005])
def test_at_or_behind_the_near_plane_nothing_is_drawn(z: float) -> None:
    gaussians = scene([[0, 0, z]]).map(lambda a: a.requires_grad_())
    out = render(gaussians, background=(0.3, 0.3, 0.3))
    assert torch.equal(out.image, torch.full_like(out.image, 0.3))
    out.image.sum().backward()
    assert all(a.grad is None or torch.isfinite(a.grad).all() for _, a in gaussians.items())


def test_the_near_plane_is_the_rigs() -> None:
    cameras = dataclasses.replace(camera(), near_plane=2.5)
    assert not render(scene([[0, 0, 2.0]]), cameras).alpha.any()
    assert render(scene([[0, 0, 3.0]]), cameras).alpha.any()


@pytest.mark.parametrize("rows_per_pass", [1, 3, 10, 64])
def test_passes_do_not_change_the_image(rows_per_pass: int) -> None:
    gaussians = random_scene(8)
    whole, parts = render(gaussians).image, render(gaussians, rows_per_pass=rows_per_pass).image
    torch.testing.assert_close(parts, whole, atol=1e-14, rtol=0)  # the sum over Gaussians may be blocked differently


def test_the_scene_may_move_with_the_camera() -> None:
    """A rigid motion of scene and camera together changes nothing, view-dependent colour aside (degree 0)."""
    angle = 0.7
    turn = np.array([[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]])
    move = np.array([0.3, -1.0, 2.0])
    gaussians = random_scene(6, bases=1)
    half = torch.tensor([math.cos(angle / 2), 0, math.sin(angle / 2), 0], dtype=torch.float64)
    w, x, y, z = gaussians.quats.unbind(1)
    a, _, c, _ = half
    quats = torch.stack([a * w - c * y, a * x + c * z, a * y + c * w, a * z - c * x], 1)
    means = gaussians.means @ torch.tensor(turn).T + torch.tensor(move)
    moved = dataclasses.replace(gaussians, means=means, quats=quats)
    torch.testing.assert_close(render(gaussians).image, render(moved, camera(turn.T, tuple(-turn.T @ move))).image)


def test_quaternion_norm_does_not_matter() -> None:
    gaussians = random_scene(4)
    bigger = dataclasses.replace(gaussians, quats=gaussians.quats * -7.5)
    torch.testing.assert_close(render(gaussians).image, render(bigger).image)


def test_spherical_harmonics_are_orthonormal() -> None:
    """Gauss-Legendre x uniform quadrature is exact for these polynomials; the 0.5 offset and clamp are kept out."""
    nodes, weights = np.polynomial.legendre.leggauss(8)
    azimuth = np.arange(16) * 2 * np.pi / 16
    z, phi = np.meshgrid(nodes, azimuth, indexing="ij")
    r = np.sqrt(1 - z**2)
    directions = torch.tensor(np.stack([r * np.cos(phi), r * np.sin(phi), z], -1).reshape(-1, 3))
    measure = np.repeat(weights, 16) * 2 * np.pi / 16
    small, n = 0.1, len(directions)
    values = []
    for k in range(16):
        coefficients = torch.zeros(n, 16, 3, dtype=torch.float64)
        coefficients[:, k] = small
        rgb = evaluate_sh(coefficients[:, :1], coefficients[:, 1:], 3.0 * directions)
        values.append((rgb[:, 0].numpy() - 0.5) / small)
    gram = np.einsum("in,jn,n->ij", np.array(values), np.array(values), measure)
    np.testing.assert_allclose(gram, np.eye(16), atol=1e-12)


def test_degree_one_points_the_fields_way() -> None:
    """Order and signs of the field: -y, z, -x."""
    directions = torch.eye(3, dtype=torch.float64)
    shN = torch.zeros(3, 3, 3, dtype=torch.float64)
    shN[:, :, 0] = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    red = evaluate_sh(torch.zeros(3, 1, 3, dtype=torch.float64), shN, directions)[:, 0] - 0.5
    np.testing.assert_allclose(red.numpy() / 0.4886025119029199, [-0.3, -0.1, 0.2], rtol=1e-12)


def test_colour_is_never_negative() -> None:
    out = render(scene([[0, 0, 2.0]], rgb=[[-3.0, 0.5, 0.5]]))
    assert float(out.image[..., 0].abs().max()) == 0.0
    assert float(out.image[..., 1].max()) > 0
