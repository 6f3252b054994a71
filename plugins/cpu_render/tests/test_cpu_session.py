"""What sessions refuse, and the memory of their caches. Results: test_cpu_sessions.py."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from cpu_scenes import BACKGROUND, HEIGHT, WIDTH
from gsstream_cpu_render.arrays import SplatArrays
from gsstream_cpu_render.pool import acquire_rasterizer, release_idle_memory
from gsstream_cpu_render.renderer import CpuRenderer
from test_cpu_fit import comparison
from test_cpu_renderer import N, backpropagate, leaves, replaced, rig, scene, upstream

from gsstream.api import Gaussians, InputError, WrtRows
from gsstream.backend import RenderSession

Scene = Gaussians[torch.Tensor]


def some_rows(count: int, seed: int) -> torch.Tensor:
    rows = np.random.default_rng(seed).permutation(N)[:count]
    return torch.from_numpy(np.sort(rows).astype(np.int64))


def moved(whole: Scene, ids: torch.Tensor, seed: int, amount: float = 0.3) -> Scene:
    """The scene with these rows moved."""
    g = torch.Generator().manual_seed(seed)
    return replaced(whole, ids, whole.rows(ids).map(lambda t: t + amount * torch.randn(t.shape, generator=g)))


def test_a_commit_of_other_rows_or_of_values_that_are_not_finite_is_refused() -> None:
    whole, ids = scene(), some_rows(20, 3)
    session = CpuRenderer().open(whole, None, rig(), BACKGROUND)
    for view in (0, 1):
        session.screen_gradient(view, upstream()[0])
    bad = moved(whole, ids, 3)
    bad.means[int(ids[4]), 1] = torch.nan
    with pytest.raises(InputError, match=r"means: expected finite values, got nan at index \[4, 1\]"):
        session.commit(bad, ids)
    with pytest.raises(InputError, match=f"expected the {N} rows of the session, got 7"):
        session.commit(whole.rows(torch.arange(7)), ids)


def test_backward_after_the_commit_is_refused() -> None:
    whole, ids = scene(), some_rows(20, 4)
    session = CpuRenderer().open(whole, ids, rig(), BACKGROUND)
    output = session.render(0, leaves(whole.rows(ids)))
    session.commit(moved(whole, ids, 4), ids)
    with pytest.raises(InputError, match="differentiate before the commit"):
        backpropagate(output)


def through_three_frames(session: RenderSession, budget: float) -> RenderSession:
    """The caches held against the budget, bytes."""
    whole = scene(5)
    for frame in range(3):
        ids = some_rows(12, frame)
        for view in (0, 1):
            session.screen_gradient(view, upstream(frame)[0])
        session.narrow(ids)
        for view in (0, 1):
            backpropagate(session.render(view, leaves(whole.rows(ids))))
        assert session.cache_bytes().total <= budget
        whole = moved(whole, ids, frame)
        session = session.commit(whole, ids)
    return session


@pytest.mark.parametrize(("views", "kept"), [(0.0, 0), (1.3, 1), (3.0, 2)])
def test_views_are_kept_while_the_budget_lasts(views: float, kept: int) -> None:
    """``views``: what the budget has room for; how large a view gets depends on the instruction set."""
    roomy = CpuRenderer(CpuRenderer.Config(cache_mb=100))  # without a limit views borrow memory of any size
    free = through_three_frames(roomy.open(scene(5), None, rig(), BACKGROUND), np.inf)
    megabytes = views * max(free.cache_bytes().per_view.values()) / 1e6
    limited = CpuRenderer(CpuRenderer.Config(cache_mb=megabytes)).open(scene(5), None, rig(), BACKGROUND)
    assert len(through_three_frames(limited, megabytes * 1e6).cache_bytes().per_view) == kept


def test_what_fits_does_not_depend_on_what_the_process_did_before() -> None:
    """A rasteriser lent by the pool brings the memory of former owners, far beyond what a small view needs."""

    def kept() -> dict[int, int]:
        session = CpuRenderer(CpuRenderer.Config(cache_mb=0.5)).open(scene(5), None, rig(), BACKGROUND)
        for view in (0, 1):
            session.screen_gradient(view, upstream()[0])
        return dict(session.cache_bytes().per_view)

    release_idle_memory()
    before = kept()
    large = acquire_rasterizer(rig(), 0, BACKGROUND)
    many = scene(5).rows(torch.arange(N).repeat(200))
    large.rasterizer.forward(SplatArrays(*(value.numpy() for _, value in many.items())))
    del large
    assert set(before) == {0, 1}
    assert kept() == before


def test_a_view_that_outgrows_the_budget_goes_and_leaves_the_pool_small() -> None:
    release_idle_memory()
    whole = scene(5)
    roomy = CpuRenderer(CpuRenderer.Config(cache_mb=100)).open(whole, None, rig(), BACKGROUND)
    for view in (0, 1):
        roomy.screen_gradient(view, upstream()[0])
    budget = roomy.cache_bytes().total + 2_000  # both views as they come, nothing to work in
    session = CpuRenderer(CpuRenderer.Config(cache_mb=budget / 1e6)).open(whole, None, rig(), BACKGROUND)
    for view in (0, 1):
        session.screen_gradient(view, upstream()[0])
    assert set(session.cache_bytes().per_view) == {0, 1}
    ids = some_rows(100, 1)
    session.narrow(ids)
    for view in (0, 1, 0, 1):
        backpropagate(session.render(view, leaves(whole.rows(ids))))
    assert len(session.cache_bytes().per_view) == 1
    assert session.cache_bytes().total <= budget
    del session
    assert release_idle_memory() < budget, "at most the one view that was drawn without a cache"


def test_layers_do_not_pile_up_where_something_has_changed_before() -> None:
    """What changes wanders over the picture; only the tiles of the last frame keep the layers of what stands still."""
    whole = scene(5)
    places = [rows.sort().values for rows in whole.means[:, 0].argsort().split(N // 8)]

    def kept(wandering: list[torch.Tensor]) -> int:
        session = CpuRenderer(CpuRenderer.Config(cache_mb=100)).open(whole, None, rig(), BACKGROUND)
        for ids in wandering:
            session.narrow(ids)
            session.loss_and_grad(0, comparison(), WrtRows(whole.rows(ids)))
            session = session.commit(whole, ids)
        return session.cache_bytes().total

    assert kept([*places, places[-1], places[-1]]) < 1.1 * kept([places[-1]] * 3)


def test_cache_bytes_follow_views_and_gaussians() -> None:
    session = CpuRenderer().open(scene(), None, rig(), BACKGROUND)
    assert session.cache_bytes().total == 0
    assert session.cache_bytes().per_camera_and_gaussian == 0
    session.screen_gradient(1, upstream()[0])
    report = session.cache_bytes()
    assert set(report.per_view) == {1}
    pixels = 4 * 4 * HEIGHT * WIDTH
    assert report.total > 64 * N + pixels
    assert report.per_camera_and_gaussian == report.total / N
    assert session.commit(scene(), torch.zeros(0, dtype=torch.int64)).cache_bytes().total == report.total
