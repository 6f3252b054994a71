"""Layers of what stands still: near the gradient of the whole scene. After any calls: test_cpu_sessions.py."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest
import torch
from cpu_scenes import BACKGROUND, random_splats
from gsstream_cpu_render.renderer import CpuLoss, CpuRenderer
from gsstream_cpu_render.session import CpuSession
from test_cpu_renderer import rig

from gsstream.api import Gaussians, WrtRows
from gsstream.backend import CameraExposure, LossAndGrad, RenderSession, ViewTarget

Scene = Gaussians[torch.Tensor]
COUNT = 700  # lists of some 150 entries a tile: several cells of the layers behind
#: Largest error of a gradient, as a share of the largest of its attribute: pixels whose transmittance fell below 1e-4
#: take no light from Gaussians one by one, but the layer behind is not cut off there.
BOUND = 2e-3


def crowd(seed: int, opaque: bool = False) -> Scene:
    return Gaussians(*(torch.from_numpy(a) for a in random_splats(COUNT, seed, 4, opaque)))


def wall(whole: Scene) -> Scene:
    """The scene behind an opaque sheet that hides about half of the picture in view 0."""
    sheet = {name: value[:1].clone() for name, value in whole.items()}
    sheet["means"][:] = torch.tensor([0.9, 0.0, -1.3])
    sheet["quats"][:] = torch.tensor([1.0, 0.0, 0.0, 0.0])
    sheet["scales"][:] = torch.log(torch.tensor([0.5, 3.0, 0.01]))
    sheet["opacities"][:] = 12.0
    merged = {name: torch.cat([sheet[name], sheet[name], value[2:]]) for name, value in whole.items()}
    return Gaussians(**merged)


def some_rows(count: int, g: torch.Generator, among: torch.Tensor | None = None) -> torch.Tensor:
    among = torch.arange(COUNT) if among is None else among
    return among[torch.randperm(len(among), generator=g)[:count]].sort().values


def moved(rows: Scene, amount: float, depth: float, g: torch.Generator) -> Scene:
    """Every value changed a little, and the places along the view by up to ``depth`` scene units."""
    changed = rows.map(lambda value: value + amount * torch.randn(value.shape, generator=g))
    along = torch.zeros(len(rows), 3)
    along[:, 2] = depth * (2 * torch.rand(len(rows), generator=g) - 1)
    return Gaussians(**{name: value + along if name == "means" else value for name, value in changed.items()})


def opened(whole: Scene, rows: torch.Tensor, **config: float) -> CpuSession:
    session = CpuRenderer(CpuRenderer.Config(**config)).open(whole, rows, rig(), BACKGROUND)
    assert isinstance(session, CpuSession)
    return session


def begun(seed: int, g: torch.Generator) -> tuple[Scene, torch.Tensor, CpuSession]:
    """A scene of the kind that the seed says, some rows of it, and a session in which they change."""
    whole = wall(crowd(seed)) if seed == 3 else crowd(seed, opaque=seed % 2 == 1)
    active = some_rows(60, g)
    return whole, active, opened(whole, active)


def comparison(dssim: float = 0.3, coloured: bool = False, tiles: torch.Tensor | None = None) -> ViewTarget:
    """With an image that is brighter than any render: no pixel is near the kink of the absolute difference."""
    cameras, g = rig(), torch.Generator().manual_seed(4)
    image = 9 + torch.rand(cameras.height, cameras.width, 3, generator=g)
    exposure = None
    if coloured:
        exposure = CameraExposure(torch.eye(3) + 0.1 * torch.rand(3, 3, generator=g), 0.1 * torch.rand(3, generator=g))
    return ViewTarget(CpuLoss(), CpuLoss().prepare(image), dssim, image, exposure, tiles)


def fused(session: CpuSession, view: int, rows: Scene, wanted: ViewTarget) -> LossAndGrad[Scene]:
    return session.loss_and_grad(view, wanted, WrtRows(rows))


def step_by_step(session: CpuSession, rows: Scene, wanted: ViewTarget, view: int = 1) -> tuple[float, Scene]:
    """The same by the body that every session has."""
    found = RenderSession.loss_and_grad(session, view, wanted, WrtRows(rows))
    return float(found.loss), found.grad


def bits(found: LossAndGrad[Scene]) -> tuple[float, dict[str, bytes]]:
    return float(found.loss), {name: value.numpy().tobytes() for name, value in found.grad.items()}


def assert_near(got: Scene, want: Scene, bound: float = BOUND) -> None:
    for (name, value), (_, truth) in zip(got.items(), want.items(), strict=True):
        np.testing.assert_allclose(value, truth, rtol=0, atol=bound * float(truth.abs().max()), err_msg=name)


def between(session: CpuSession, view: int) -> int:
    """Entries that the last pass of a view blended."""
    return int(session._view(view).rasterizer._native.entry_count)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("dssim", [0.0, 0.5])
def test_an_active_gradient_is_near_that_of_the_whole_scene(seed: int, dssim: float, isa: str) -> None:
    g = torch.Generator().manual_seed(seed)
    whole, active, session = begun(seed, g)
    for step in range(5):
        rows = moved(whole.rows(active), 0.02, 0.1 * step, g)
        found, (loss, gradients) = (
            fused(session, 0, rows, comparison(dssim)),
            step_by_step(opened(whole, active), rows, comparison(dssim), 0),
        )
        assert float(found.loss) == pytest.approx(loss, rel=1e-4)
        assert_near(found.grad, gradients)
        if step == 2:
            active = active[::2]
            session.narrow(active)


def test_with_nothing_behind_the_active_rows_gradients_have_the_bits_of_the_whole_scene(isa: str, threads: int) -> None:
    whole, g = crowd(6), torch.Generator().manual_seed(6)
    active = some_rows(40, g)
    whole.means[:, 2].clamp_(max=0.2)
    whole.means[active, 2] += 4  # behind the others, as seen by either camera
    session = opened(whole, active)
    for step in range(4):
        rows = moved(whole.rows(active), 0.02, 0.2 * step, g)
        found = fused(session, 1, rows, comparison())
        loss, gradients = step_by_step(opened(whole, active), rows, comparison())
        assert found.loss == loss
        assert bits(found)[1] == bits(replace(found, grad=gradients))[1]
        assert all(bool(value.any()) for _, value in gradients.items())


def test_the_layers_hold_most_of_a_crowd_and_the_more_the_fewer_rows_change() -> None:
    whole, g = crowd(1), torch.Generator().manual_seed(1)
    active = some_rows(6, g)
    session = opened(whole, active)
    session.render(0, whole.rows(active))
    every = between(session, 0)
    fused(session, 0, whole.rows(active), comparison())
    few = between(session, 0)
    session.narrow(active[:1])
    fused(session, 0, whole.rows(active[:1]), comparison())
    assert between(session, 0) < few < 0.7 * every


def test_rows_that_leave_the_view_and_come_back(isa: str) -> None:
    whole, g = crowd(2), torch.Generator().manual_seed(2)
    active = some_rows(30, g)
    session, here = opened(whole, active), whole.rows(active)
    away = here.map(torch.clone)
    away.means[:] += 100
    before = bits(fused(session, 0, here, comparison()))
    gone = fused(session, 0, away, comparison())
    assert not any(bool(value.any()) for _, value in gone.grad.items())
    assert bits(fused(session, 0, here, comparison())) == before


def test_gaussians_at_one_depth() -> None:
    """Ties go by row, also between rows that change and rows in the layers."""
    whole, g = crowd(8), torch.Generator().manual_seed(8)
    whole.means[:] = whole.means[(torch.arange(COUNT) // 50) * 50]
    active = some_rows(40, g)
    session = opened(whole, active)
    for step in range(3):
        rows = whole.rows(active) if step != 1 else moved(whole.rows(active), 0.0, 0.5, g)
        found = fused(session, 0, rows, comparison())
        assert bits(found) == bits(fused(opened(whole, active), 0, rows, comparison()))
        assert_near(found.grad, step_by_step(opened(whole, active), rows, comparison(), 0)[1])


def test_layers_count_as_memory() -> None:
    whole, g = crowd(9), torch.Generator().manual_seed(9)
    active = some_rows(40, g)
    session = opened(whole, active)
    native = session._view(0).rasterizer._native
    fused(session, 0, whole.rows(active), comparison())
    layered = native.memory_bytes()
    native.free_scratch()
    pixels = 6 * 32 * 16 * 7 * 4  # tiles of the picture, their pixels, transmittance and two colours
    assert layered - native.memory_bytes() > pixels
    session.narrow(active)
    session.render(0, whole.rows(active))
    rendered = native.memory_bytes()
    fused(session, 0, whole.rows(active), comparison())
    assert native.memory_bytes() - rendered > pixels


def test_a_fused_pass_leaves_layers_alone_in_the_memory_of_a_view() -> None:
    """Lists, pixels and moments of a pass lie where those of the next view will."""
    whole, g = crowd(9), torch.Generator().manual_seed(9)
    active = some_rows(40, g)
    session, rows = opened(whole, active), whole.rows(active)
    native = session._view(0).rasterizer._native
    before = native.memory_bytes()
    fused(session, 0, rows, comparison())
    layers = native.memory_bytes() - before
    session.render(0, rows)  # not fused: its backward may come at any time
    assert native.memory_bytes() - before > layers + 8 * rig().width * rig().height
    tiles = -(-rig().width // 32) * -(-rig().height // 16)
    assert layers < tiles * 16_000 + 48 * len(whole)


def test_fits_of_two_threads_on_one_view_are_refused_or_right() -> None:
    whole, g = crowd(9), torch.Generator().manual_seed(9)
    active = some_rows(300, g)
    session, rows, wanted = opened(whole, active), whole.rows(active), comparison()
    want, found, messages = bits(fused(session, 0, rows, wanted)), [], []

    def work() -> None:
        for _ in range(40):
            try:
                found.append(bits(fused(session, 0, rows, wanted)))
            except RuntimeError as error:
                messages.append(str(error))

    workers = [threading.Thread(target=work) for _ in range(3)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    assert len(found) + len(messages) == 120
    assert all(one == want for one in found)
    assert all("one Rasterizer per camera and thread" in message for message in messages)


def test_no_backward_of_a_render_may_follow_a_fused_pass() -> None:
    """What a fused pass leaves is not what `backward_active` differentiates."""
    whole, g = crowd(3), torch.Generator().manual_seed(3)
    active = some_rows(20, g)
    session = opened(whole, active)
    output = session.render(0, whole.rows(active).map(lambda value: value.clone().requires_grad_()))
    rasterizer = session._view(0).rasterizer
    rasterizer.backward_active(np.ones_like(output.image.detach().numpy()))
    fused(session, 0, whole.rows(active), comparison())
    with pytest.raises(ValueError, match="backward_active: expected a forward_active pass before"):
        rasterizer.backward_active(np.ones_like(output.image.detach().numpy()))
