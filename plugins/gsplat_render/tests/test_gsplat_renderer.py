"""The renderer contract against the reference renderer: on a GPU where there is one, everywhere on a stand-in."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from gsstream_gsplat_render.kernels import Kernels, load_kernels
from gsstream_gsplat_render.renderer import GsplatRenderer
from gsstream_gsplat_render.rig import Rigs
from gsstream_gsplat_render.session import GsplatSession
from torch_kernels import TORCH_KERNELS

from gsstream.api import Cameras, Gaussians, PluginUnavailable, ShapeError
from gsstream.backend import RenderOutput
from gsstream.parts.backend.reference import ReferenceRenderer
from gsstream.testing import parametrize_with_checks

N, WIDTH, HEIGHT = 120, 49, 37  # the size is no multiple of a tile
BACKGROUND = (0.2, 0.5, 0.9)
REASON = "needs an NVIDIA GPU with gsplat's kernels (pip install 'gsstream-gsplat-render[cuda]')"


@dataclass(frozen=True)
class Backend:
    """Functions, their device, and how far from float64 they may be.

    Arguments:
        image: largest error of a pixel: an alpha at the cut of 1/255 may fall on either side on a GPU.
        mean: mean error of all pixels.
        gradient: norm of the error over the norm of the gradient, per attribute.
    """

    kernels: Kernels
    device: str
    image: float
    mean: float
    gradient: float


@pytest.fixture(params=["torch", "cuda"])
def backend(request: pytest.FixtureRequest) -> Backend:
    if request.param == "torch":
        return Backend(TORCH_KERNELS, "cpu", image=3e-4, mean=2e-5, gradient=2e-3)
    try:
        return Backend(load_kernels("cuda"), "cuda", image=1e-2, mean=1e-4, gradient=1e-2)
    except PluginUnavailable as error:
        pytest.skip(f"{REASON}: {error}")


def rig() -> Cameras:
    angle = 0.3
    viewmat = np.eye(4)
    viewmat[0, [0, 2]] = np.cos(angle), np.sin(angle)
    viewmat[2, [0, 2]] = -np.sin(angle), np.cos(angle)
    viewmat[2, 3] = 3.0
    second = viewmat.copy()
    second[0, 3] = 0.4
    K = np.array([[50.0, 0, WIDTH / 2 + 0.7], [0, 47.5, HEIGHT / 2 - 0.4], [0, 0, 1]])
    return Cameras(("a", "b"), np.stack([viewmat, second]), np.stack([K, K]), WIDTH, HEIGHT)


def scene(seed: int = 0, coefficients: int = 9, count: int = N) -> Gaussians[torch.Tensor]:
    rng = np.random.default_rng(seed)
    sh = rng.normal(size=(count, coefficients, 3)) * 0.3
    arrays = (
        rng.uniform([-1.6, -1.6, -4.0], [1.6, 1.6, 1.0], (count, 3)),  # some behind the camera, some beside it
        rng.normal(size=(count, 4)),
        np.log(0.02 + 0.25 * rng.random((count, 3)) ** 2),
        rng.normal(size=count) * 1.5,
        sh[:, :1],
        sh[:, 1:],
    )
    return Gaussians(*(torch.tensor(a, dtype=torch.float32) for a in arrays))


def leaves(gaussians: Gaussians[torch.Tensor]) -> Gaussians[torch.Tensor]:
    return gaussians.map(lambda t: t.detach().clone().requires_grad_())


def backpropagate(output: RenderOutput) -> None:
    g = torch.Generator().manual_seed(5)
    v_image, v_alpha = torch.randn(HEIGHT, WIDTH, 3, generator=g), torch.randn(HEIGHT, WIDTH, generator=g)
    torch.autograd.backward([output.image, output.alpha], [v_image.to(output.image), v_alpha.to(output.alpha)])


def open_session(
    backend: Backend, gaussians: Gaussians[torch.Tensor], active: torch.Tensor | None = None
) -> GsplatSession:
    return GsplatSession(backend.kernels, Rigs(torch.device(backend.device)), gaussians, active, rig(), BACKGROUND)


def relative(got: torch.Tensor, want: torch.Tensor) -> float:
    error, size = float((got - want).norm()), float(want.norm())
    return error / size if size > 0 else error


def assert_images_agree(backend: Backend, got: RenderOutput, want: RenderOutput) -> None:
    for a, b in ((got.image, want.image), (got.alpha, want.alpha)):
        assert a.device.type == "cpu"
        error = (a - b).detach().abs()
        assert float(error.max()) < backend.image
        assert float(error.mean()) < backend.mean


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
@pytest.mark.parametrize("view", [0, 1])
def test_image_and_gradients_agree_with_the_reference(backend: Backend, view: int, coefficients: int) -> None:
    ours = leaves(scene(coefficients=coefficients))
    truth = leaves(scene(coefficients=coefficients).map(torch.Tensor.double))
    got = open_session(backend, ours).render(view, ours)
    want = ReferenceRenderer().render(truth, rig(), view, BACKGROUND)
    assert_images_agree(backend, got, want)
    backpropagate(got)
    backpropagate(want)
    for (name, g), (_, w) in zip(ours.items(), truth.items(), strict=True):
        if w.numel():
            assert g.grad is not None
            assert w.grad is not None
            assert torch.isfinite(g.grad).all(), name
            assert relative(g.grad, w.grad) < backend.gradient, name


def test_screen_gradient_agrees_with_the_reference(backend: Backend) -> None:
    v_image = torch.randn(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(1))
    got = open_session(backend, scene()).screen_gradient(0, v_image)
    want = ReferenceRenderer().screen_gradient(scene().map(torch.Tensor.double), rig(), 0, v_image.double())
    assert relative(got.gradient, want.gradient) < backend.gradient
    assert not ((want.gradient != 0).any(1) & ~got.visible).any()
    assert 0 < int(got.visible.sum()) < N


def test_visible_in_tiles_agrees_with_the_reference(backend: Backend) -> None:
    """But for rows at a cut; gsplat leaves out the Gaussian that would take the transmittance below 1e-4."""
    session = open_session(backend, scene(), torch.tensor([90, 3, 40, 41]))
    truth = ReferenceRenderer().open(scene().map(torch.Tensor.double), None, rig(), BACKGROUND)
    for place in range(12):
        tiles = (torch.arange(12) == place).reshape(3, 4)
        got, want = session.visible(0, tiles), truth.visible(0, tiles)
        assert int((got != want).sum()) <= 2
        assert got.shape == (N,)
    assert not bool(session.visible(0, torch.zeros(3, 4, dtype=torch.bool)).any())
    assert bool(session.visible(0, torch.ones(3, 4, dtype=torch.bool)).any())
    with pytest.raises(ShapeError, match=r"tiles: expected bool \[3, 4\]"):
        session.visible(0, torch.ones(4, 3, dtype=torch.bool))


def test_a_session_of_some_rows_equals_the_whole_scene(backend: Backend) -> None:
    base, moved = scene(), scene(seed=1)
    active = torch.tensor([90, 3, 40, 41])
    whole = Gaussians(**{n: v.index_copy(0, active, dict(moved.items())[n][active]) for n, v in base.items()}).map(
        torch.Tensor.requires_grad_
    )
    rows, probe = leaves(moved.rows(active)), torch.zeros(4, 2, requires_grad=True)
    got = open_session(backend, base, active).render(0, rows, probe=probe)
    want = open_session(backend, whole).render(0, whole)
    assert torch.allclose(got.image, want.image, atol=1e-6)
    backpropagate(got)
    backpropagate(want)
    for (name, g), (_, w) in zip(rows.items(), whole.items(), strict=True):
        assert g.grad is not None
        assert w.grad is not None
        assert relative(g.grad, w.grad[active]) < 1e-4, name
    assert probe.grad is not None
    assert float(probe.grad.abs().max()) > 0


def test_the_probe_is_the_screen_gradient(backend: Backend) -> None:
    probe = torch.zeros(N, 2, requires_grad=True)
    v_image = torch.randn(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(1))
    open_session(backend, scene()).render(0, scene(), probe=probe).image.backward(v_image)
    want = open_session(backend, scene()).screen_gradient(0, v_image)
    # The background takes part in one and not in the other: subtract it.
    black = GsplatSession(backend.kernels, Rigs(torch.device(backend.device)), scene(), None, rig(), (0.0, 0.0, 0.0))
    second = torch.zeros(N, 2, requires_grad=True)
    black.render(0, scene(), probe=second).image.backward(v_image)
    assert second.grad is not None
    assert probe.grad is not None
    assert relative(second.grad, want.gradient) < 1e-4
    assert relative(probe.grad, want.gradient) > 1e-3


def checker() -> torch.Tensor:
    mask = torch.zeros(3, 4, dtype=torch.bool)
    mask[0, 1] = mask[2, 3] = True
    return mask


def in_pixels(mask: torch.Tensor) -> torch.Tensor:
    return mask.repeat_interleave(16, 0).repeat_interleave(16, 1)[:HEIGHT, :WIDTH]


def test_masked_tiles_show_the_background_and_pass_no_gradient(backend: Backend) -> None:
    inside = in_pixels(checker())
    ours, whole = leaves(scene()), leaves(scene())
    got = open_session(backend, ours).render(0, ours, tile_mask=checker())
    want = open_session(backend, whole).render(0, whole)
    assert torch.allclose(got.image[inside], want.image[inside], atol=1e-6)
    assert torch.allclose(got.image[~inside], torch.tensor(BACKGROUND))
    assert float(got.alpha[~inside].detach().abs().max()) == 0
    v_image = torch.randn(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(2))
    torch.autograd.backward([got.image, got.alpha], [v_image, v_image[..., 0].contiguous()])
    outside = ~inside
    v_image[outside] = 0
    torch.autograd.backward([want.image, want.alpha], [v_image, v_image[..., 0].contiguous()])
    for (name, g), (_, w) in zip(ours.items(), whole.items(), strict=True):
        assert g.grad is not None
        assert w.grad is not None
        assert relative(g.grad, w.grad) < 1e-4, name


def test_masked_tiles_of_a_session_hold_the_render_it_was_opened_with(backend: Backend) -> None:
    base, active = scene(), torch.arange(0, N, 3)
    session = open_session(backend, base, active)
    got = session.render(0, scene(seed=1).rows(active), tile_mask=checker())
    before = open_session(backend, base).render(0, base)
    inside = in_pixels(checker())
    assert torch.allclose(got.image[~inside], before.image[~inside], atol=1e-6)
    assert torch.allclose(got.alpha[~inside], before.alpha[~inside], atol=1e-6)
    assert not torch.allclose(got.image[inside], before.image[inside], atol=1e-3)


@pytest.mark.parametrize("count", [0, 5])
def test_nothing_to_see(backend: Backend, count: int) -> None:
    behind = scene(count=count)
    behind = Gaussians(**{**dict(behind.items()), "means": behind.means - torch.tensor([0.0, 0.0, 50.0])})
    rows = leaves(behind)
    got = open_session(backend, behind).render(0, rows)
    assert torch.allclose(got.image, torch.tensor(BACKGROUND).expand(HEIGHT, WIDTH, 3))
    assert float(got.alpha.detach().abs().max()) == 0
    gradient = open_session(backend, behind).screen_gradient(0, torch.ones(HEIGHT, WIDTH, 3))
    assert (gradient.gradient.shape, int(gradient.visible.sum())) == ((count, 2), 0)
    assert float(gradient.gradient.abs().sum()) == 0


def test_what_does_not_fit_is_refused(backend: Backend) -> None:
    session = open_session(backend, scene())
    with pytest.raises(ShapeError, match=r"tile_mask: expected bool \[3, 4\]"):
        session.render(0, scene(), tile_mask=torch.ones(4, 3, dtype=torch.bool))
    with pytest.raises(ShapeError, match=r"means: expected dtype torch.float32"):
        session.render(0, scene().map(torch.Tensor.double))


@pytest.mark.skipif(torch.cuda.is_available(), reason="this machine has a GPU")
def test_without_a_gpu_the_message_says_so() -> None:
    with pytest.raises(PluginUnavailable, match=r"expected an NVIDIA GPU .* found none .*--renderer cpu"):
        GsplatRenderer()


@pytest.mark.parametrize("backend", ["cuda"], indirect=True)
def test_the_part_itself_renders(backend: Backend) -> None:
    got = GsplatRenderer().render(scene(), rig(), 0, BACKGROUND)
    want = ReferenceRenderer().render(scene().map(torch.Tensor.double), rig(), 0, BACKGROUND)
    assert_images_agree(backend, got, want)


try:
    load_kernels("cuda")
except PluginUnavailable as error:

    @pytest.mark.skip(reason=f"needs an NVIDIA GPU with gsplat's kernels: {error}")
    def test_contract() -> None: ...

else:

    @parametrize_with_checks([GsplatRenderer()])
    def test_contract(check) -> None:
        check()
