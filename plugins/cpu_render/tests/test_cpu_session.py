"""Sessions from frame to frame: a committed session is one opened anew, bit for bit, whatever was changed."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from cpu_scenes import BACKGROUND, HEIGHT, WIDTH
from gsstream_cpu_render.arrays import SplatArrays
from gsstream_cpu_render.pool import acquire_rasterizer, release_idle_memory
from gsstream_cpu_render.renderer import CpuRenderer
from test_cpu_renderer import N, grads, leaves, pull, replaced, rig, scene, upstream

from gsstream.api import Gaussians, InputError, Renderer, RenderSession, ScatterSession, ScreenGradient
from gsstream.parts.render.reference import ReferenceRenderer

Scene = Gaussians[torch.Tensor]


def some_rows(count: int, seed: int) -> torch.Tensor:
    rows = np.random.default_rng(seed).permutation(N)[:count]
    return torch.from_numpy(np.sort(rows).astype(np.int64))


def moved(whole: Scene, ids: torch.Tensor, seed: int, amount: float = 0.3) -> Scene:
    """The scene with these rows moved."""
    g = torch.Generator().manual_seed(seed)
    return replaced(whole, ids, whole.rows(ids).map(lambda t: t + amount * torch.randn(t.shape, generator=g)))


def sparse_upstream(seed: int) -> torch.Tensor:
    """An image gradient that is zero in all but one corner."""
    v_image = upstream(seed)[0].clone()
    v_image[: HEIGHT // 2] = 0
    v_image[:, : WIDTH // 3] = 0
    return v_image


def full_screen_gradient(whole: Scene, view: int, v_image: torch.Tensor) -> ScreenGradient:
    """By the full pass, which renders everything and differentiates everything."""
    held = acquire_rasterizer(rig(), view, BACKGROUND)
    rasterizer = held.rasterizer
    rasterizer.forward(SplatArrays(*(value.numpy() for _, value in whole.items())))
    visible = torch.zeros(N, dtype=torch.bool)
    visible[torch.from_numpy(rasterizer.visible_rows().astype(np.int64))] = True
    return ScreenGradient(torch.from_numpy(rasterizer.backward(v_image.numpy()).means2d), visible)


def assert_alike(subject: RenderSession, whole: Scene, seed: int, renderer: Renderer | None = None) -> None:
    """`subject` does what a session opened with `whole` does."""
    renderer = renderer or CpuRenderer()
    fresh = renderer.open(whole, None, rig(), BACKGROUND)
    mask = torch.from_numpy(np.random.default_rng(seed).random((3, 4)) < 0.5)
    for view in (0, 1):
        for v_image in (upstream(seed)[0], sparse_upstream(seed), torch.zeros(HEIGHT, WIDTH, 3)):
            got, want = subject.screen_gradient(view, v_image), fresh.screen_gradient(view, v_image)
            for other in (want, full_screen_gradient(whole, view, v_image)):
                assert torch.equal(got.gradient, other.gradient)
                assert torch.equal(got.visible, other.visible)
    ids = some_rows(15, seed + 1000)
    rows = moved(whole, ids, seed + 1).rows(ids)
    for session in (subject, fresh):
        session.narrow(ids)
    for view, tiles in ((0, None), (1, mask), (0, mask), (1, None)):
        got_rows, want_rows = leaves(rows), leaves(rows)
        got_image = subject.render(view, got_rows, tile_mask=tiles)
        want_image = fresh.render(view, want_rows, tile_mask=tiles)
        assert torch.equal(got_image.image, want_image.image)
        assert torch.equal(got_image.alpha, want_image.alpha)
        assert torch.equal(got_image.tiles, want_image.tiles)
        pull(got_image, seed)
        pull(want_image, seed)
        assert all(torch.equal(a, b) for a, b in zip(grads(got_rows), grads(want_rows), strict=True))


@pytest.mark.parametrize("count", [0, 1, 20, N])
def test_a_committed_session_is_one_opened_anew(count: int, threads: int) -> None:
    whole = scene(threads)
    session = CpuRenderer().open(whole, None, rig(), BACKGROUND)
    for frame in range(6):
        ids = some_rows(count, frame)
        if frame % 2 == 0:
            session.screen_gradient(0, sparse_upstream(frame))
        session.narrow(ids)
        pull(session.render(frame % 2, leaves(whole.rows(ids))))
        whole = moved(whole, ids, frame)
        session = session.commit(whole, ids)
        assert_alike(session, whole, frame)


def test_many_commits_without_looking() -> None:
    """Tile lists that grow and shrink again and again are moved and packed; nothing is lost."""
    start = scene(3)
    tight = Gaussians(start.means * 0.1, *[value for _, value in start.items()][1:])
    session = CpuRenderer().open(start, None, rig(), BACKGROUND)
    for view in (0, 1):
        session.screen_gradient(view, upstream()[0])
    whole = start
    for frame in range(60):
        ids = some_rows(N // 2, frame)
        whole = replaced(whole, ids, (tight if frame % 2 else start).rows(ids))
        session = session.commit(whole, ids)
    assert_alike(session, whole, 7)


def test_rows_that_were_not_active_may_be_committed() -> None:
    whole = scene()
    session = CpuRenderer().open(whole, some_rows(10, 0), rig(), BACKGROUND)
    session.render(0, whole.rows(some_rows(10, 0)))
    ids = some_rows(30, 1)
    after = moved(whole, ids, 1)
    assert_alike(session.commit(after, torch.flip(ids, [0])), after, 1)


def test_a_commit_leaves_the_old_session_as_it_was() -> None:
    whole, ids = scene(), some_rows(20, 2)
    session = CpuRenderer().open(whole, None, rig(), BACKGROUND)
    session.screen_gradient(0, upstream()[0])
    session.commit(moved(whole, ids, 2), ids)
    assert_alike(session, whole, 2)


def test_a_refused_commit_changes_nothing() -> None:
    whole, ids = scene(), some_rows(20, 3)
    session = CpuRenderer().open(whole, None, rig(), BACKGROUND)
    for view in (0, 1):
        session.screen_gradient(view, upstream()[0])
    bad = moved(whole, ids, 3)
    bad.means[int(ids[4]), 1] = torch.nan
    with pytest.raises(InputError, match=r"means: expected finite values, got nan at index \[4, 1\]"):
        session.commit(bad, ids)
    assert_alike(session, whole, 3)
    with pytest.raises(InputError, match=f"expected the {N} rows of the session, got 7"):
        session.commit(whole.rows(torch.arange(7)), ids)


def test_backward_after_the_commit_is_refused() -> None:
    whole, ids = scene(), some_rows(20, 4)
    session = CpuRenderer().open(whole, ids, rig(), BACKGROUND)
    output = session.render(0, leaves(whole.rows(ids)))
    session.commit(moved(whole, ids, 4), ids)
    with pytest.raises(InputError, match="differentiate before the commit"):
        pull(output)


def through_three_frames(session: RenderSession, budget: float) -> RenderSession:
    """Each frame held against a session of its own, and the caches against the budget, bytes."""
    whole = scene(5)
    for frame in range(3):
        ids = some_rows(12, frame)
        assert_alike(session, whole, frame)
        assert session.cache_bytes().total <= budget
        whole = moved(whole, ids, frame)
        session = session.commit(whole, ids)
    return session


@pytest.mark.parametrize(("views", "kept"), [(0.0, 0), (1.3, 1), (3.0, 2)])
def test_the_same_bits_beyond_the_budget(views: float, kept: int) -> None:
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
        pull(session.render(view, leaves(whole.rows(ids))))
    assert len(session.cache_bytes().per_view) == 1
    assert session.cache_bytes().total <= budget
    del session
    assert release_idle_memory() < budget, "at most the one view that was drawn without a cache"


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


def test_the_session_every_renderer_has_commits_too() -> None:
    whole, ids = scene().rows(torch.arange(8)), torch.tensor([1, 5])
    session = ReferenceRenderer().open(whole, ids, rig(), BACKGROUND)
    assert isinstance(session, ScatterSession)
    after = Gaussians(**{**dict(whole.items()), "means": whole.means.index_add(0, ids, torch.full((2, 3), 0.1))})
    session = session.commit(after, ids)
    assert session.cache_bytes().total == 0
    image = session.render(0, after).image
    assert torch.equal(image, ReferenceRenderer().render(after, rig(), 0, BACKGROUND).image)
