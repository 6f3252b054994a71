"""The renderer part: autograd, sessions, and the pool of its idle rasterisers."""

from __future__ import annotations

import gc
import subprocess
import sys
import threading
from typing import Any

import numpy as np
import pytest
import torch
from cpu_scenes import BACKGROUND, HEIGHT, WIDTH, camera, random_splats
from gsstream_cpu_render import pool
from gsstream_cpu_render.pool import release_idle_memory
from gsstream_cpu_render.renderer import CpuRenderer

from gsstream.api import Cameras, Gaussians
from gsstream.backend import RenderOutput
from gsstream.parts.backend.reference import ReferenceRenderer

N = 120


def rig() -> Cameras:
    viewmat, K = camera()
    second = viewmat.copy()
    second[0, 3] = 0.4
    return Cameras(("a", "b"), np.stack([viewmat, second]), np.stack([K, K]), WIDTH, HEIGHT)


def scene(seed: int = 0, coefficients: int = 9) -> Gaussians[torch.Tensor]:
    return Gaussians(*(torch.from_numpy(a) for a in random_splats(N, seed, coefficients)))


def leaves(gaussians: Gaussians[torch.Tensor]) -> Gaussians[torch.Tensor]:
    return gaussians.map(lambda t: t.detach().clone().requires_grad_())


def upstream(seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    return torch.randn(HEIGHT, WIDTH, 3, generator=g), torch.randn(HEIGHT, WIDTH, generator=g)


def backpropagate(output: RenderOutput, seed: int = 0) -> None:
    v_image, v_alpha = upstream(seed)
    torch.autograd.backward([output.image, output.alpha], [v_image.to(output.image), v_alpha.to(output.alpha)])


def grads(gaussians: Gaussians[torch.Tensor]) -> list[torch.Tensor]:
    found = [t.grad for _, t in gaussians.items()]
    assert all(g is not None for g in found)
    return [g for g in found if g is not None]


def replaced(
    whole: Gaussians[torch.Tensor], ids: torch.Tensor, rows: Gaussians[torch.Tensor]
) -> Gaussians[torch.Tensor]:
    base = dict(whole.items())
    return Gaussians(**{name: base[name].index_copy(0, ids, value.detach()) for name, value in rows.items()})


def test_near_plane_of_the_rig_is_used() -> None:
    cameras = rig()
    cut = Cameras(cameras.ids, cameras.viewmats, cameras.Ks, WIDTH, HEIGHT, near_plane=3.0)
    got = CpuRenderer().render(scene(), cut, 0, BACKGROUND).image
    want = ReferenceRenderer().render(scene().map(torch.Tensor.double), cut, 0, BACKGROUND).image
    assert float((got - want).abs().max()) < 2e-5
    assert not torch.equal(got, CpuRenderer().render(scene(), cameras, 0, BACKGROUND).image)


def test_a_backward_in_the_middle_of_other_renders() -> None:
    renderer, first = CpuRenderer(), leaves(scene())
    output = renderer.render(first, rig(), 0, BACKGROUND)
    for seed in range(3):
        backpropagate(renderer.render(leaves(scene(seed)), rig(), 0, BACKGROUND))
    backpropagate(output)
    alone = leaves(scene())
    backpropagate(renderer.render(alone, rig(), 0, BACKGROUND))
    assert all(torch.equal(a, b) for a, b in zip(grads(first), grads(alone), strict=True))


def test_changing_an_input_before_backward_is_refused() -> None:
    gaussians = leaves(scene())
    output = CpuRenderer().render(gaussians, rig(), 0, BACKGROUND)
    with torch.no_grad():
        gaussians.means.add_(1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        backpropagate(output)


def test_image_alone_and_alpha_alone() -> None:
    v_image, v_alpha = upstream()
    both, image, alpha = (leaves(scene()) for _ in range(3))
    backpropagate(CpuRenderer().render(both, rig(), 0, BACKGROUND))
    CpuRenderer().render(image, rig(), 0, BACKGROUND).image.backward(v_image)
    CpuRenderer().render(alpha, rig(), 0, BACKGROUND).alpha.backward(v_alpha)
    for b, i, a in zip(grads(both), grads(image), grads(alpha), strict=True):
        torch.testing.assert_close(b, i + a, rtol=0, atol=1e-5 * float(b.abs().max()))


def test_tensors_that_are_not_contiguous() -> None:
    gaussians = scene()
    sh = torch.cat([gaussians.sh0, gaussians.shN], 1)
    strided = Gaussians(
        gaussians.means.T.contiguous().T, *list(dict(gaussians.items()).values())[1:4], sh[:, :1], sh[:, 1:]
    )
    assert not strided.shN.is_contiguous()
    got = CpuRenderer().render(strided, rig(), 0, BACKGROUND).image
    assert torch.equal(got, CpuRenderer().render(gaussians, rig(), 0, BACKGROUND).image)


@pytest.mark.parametrize("ids", [[], [7], [3, 17, 80]])
def test_session_tells_the_tiles_its_rows_are_in(ids: list[int]) -> None:
    index = torch.tensor(ids, dtype=torch.int64)
    session = CpuRenderer().open(scene(), index, rig(), BACKGROUND)
    old = CpuRenderer().render(scene(), rig(), 1, BACKGROUND).image
    for step in range(3):
        rows = leaves(scene().rows(index).map(lambda t, s=step: t + 0.1 * s))
        output = session.render(1, rows)
        assert output.tiles is not None
        assert output.tiles.shape == (-(-HEIGHT // 16), -(-WIDTH // 16))
        inside = output.tiles.repeat_interleave(16, 0).repeat_interleave(16, 1)[:HEIGHT, :WIDTH]
        assert torch.equal(output.image[~inside], old[~inside])
        # Nor has anything outside a gradient by the rows.
        outside = torch.rand(HEIGHT, WIDTH, 3, generator=torch.Generator().manual_seed(step)) * ~inside[..., None]
        (output.image * outside).sum().backward()
        assert not any(bool(g.any()) for g in grads(rows) if g is not None)
        assert bool(inside.any()) == bool(ids)


def test_rasterisers_return_to_the_pool() -> None:
    gc.collect()
    release_idle_memory()
    for seed in range(3):
        backpropagate(CpuRenderer().render(leaves(scene(seed)), rig(), 0, BACKGROUND))
    one = release_idle_memory()
    outputs = [CpuRenderer().render(leaves(scene()), rig(), 0, BACKGROUND) for _ in range(3)]
    assert release_idle_memory() == 0  # all three wait for their backward
    del outputs
    assert release_idle_memory() > 1.5 * one > 0


K = np.array([[20.0, 0, 8], [0, 20, 8], [0, 0, 1]])
RIG = Cameras(("one",), np.eye(4)[None], K[None], 16, 16)


def test_a_lease_that_is_collected_while_the_pool_is_at_work(monkeypatch: pytest.MonkeyPatch) -> None:
    """The finaliser once waited for the lock that its own thread held: the encoder stood still for ever."""
    held = [pool.acquire_rasterizer(RIG, 0, (0.0, 0.0, 0.0)) for _ in range(2)]
    held.pop()  # one idle rasteriser, so that the pool has something to look through
    isa = pool._native.active_isa

    class Collecting:
        """Drops the last reference to a lease where the pool allocates, as the collector may."""

        def active_isa(self) -> Any:
            held.clear()
            return isa()

    monkeypatch.setattr(pool, "_native", Collecting())
    made: list[Any] = []
    worker = threading.Thread(target=lambda: made.append(pool.acquire_rasterizer(RIG, 0, (0.0, 0.0, 0.0))), daemon=True)
    worker.start()
    worker.join(30)
    assert made, "the pool waits for itself"
    assert held == []


def test_a_lease_that_outlives_its_module_is_dropped_without_a_word() -> None:
    """Python takes a module's names away at its end; the finaliser of before then raised a TypeError to stderr."""
    program = """
import numpy as np
from gsstream_cpu_render import pool
from gsstream.core.cameras import Cameras
rig = Cameras(("one",), np.eye(4)[None], np.array([[[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]]), 16, 16)
held = pool.acquire_rasterizer(rig, 0, (0.0, 0.0, 0.0))
pool._lock = None
"""
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=120)
    assert (ended.returncode, ended.stderr) == (0, "")
