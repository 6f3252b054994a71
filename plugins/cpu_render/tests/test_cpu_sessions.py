"""Sessions under any calls in any order: each result is that of a session opened anew on the same scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from cpu_scenes import BACKGROUND, HEIGHT, WIDTH, random_splats
from gsstream_cpu_render import _native
from gsstream_cpu_render.arrays import SplatArrays
from gsstream_cpu_render.pool import acquire_rasterizer
from gsstream_cpu_render.renderer import CpuRenderer
from gsstream_cpu_render.threads import set_num_threads
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)
from test_cpu_fit import comparison, some_tiles
from test_cpu_raster_properties import masked_pixels, random_mask
from test_cpu_renderer import backpropagate, grads, leaves, replaced, rig, upstream

from gsstream.api import Gaussians, WrtRows, WrtTransforms
from gsstream.backend import LossAndGrad, RenderOutput, RenderSession, WrtScene
from gsstream.blocks import GroupTransforms

Scene = Gaussians[torch.Tensor]
#: Number of Gaussians, and whether they are opaque. A tile of the last has several cells of layers behind it.
KINDS = {"sparse": (60, False), "opaque": (60, True), "at few depths": (60, False), "crowd": (700, False)}
BUDGETS = [None, None, None, 0.06, 0.0]  # megabytes: room for every view, for one or two small ones, for none
VIEWS, SEEDS, FLAGS = st.integers(0, 1), st.integers(0, 999), st.booleans()
COUNTS = st.sampled_from([20, 60, 6, 20, 6, 1, 0])
AMOUNTS = st.sampled_from([0.3, 0.02, 0.3, 0.0, 100.0])  # rows that move by the last leave the picture


def built(kind: str, seed: int) -> Scene:
    count, opaque = KINDS[kind]
    whole = Gaussians(*(torch.from_numpy(a) for a in random_splats(count, seed, 4, opaque)))
    if kind == "at few depths":
        whole.means[:] = whole.means[torch.arange(count) // 20 * 20]
    return whole


def chosen(rows: int, count: int, seed: int, ordered: bool = True) -> torch.Tensor:
    some = torch.randperm(rows, generator=torch.Generator().manual_seed(seed))[:count]
    return some.sort().values if ordered else some


def moved(rows: Scene, amount: float, seed: int) -> Scene:
    """Every value changed by about ``amount``; by a large one the places alone."""
    if amount > 1:
        return replace(rows, means=rows.means + amount)
    g = torch.Generator().manual_seed(seed)
    return rows.map(lambda value: value + amount * torch.randn(value.shape, generator=g))


def image_gradient(seed: int, sparse: bool) -> torch.Tensor:
    """Gradient of an image; a sparse one is zero in all but a corner."""
    v_image = upstream(seed)[0].clone()
    if sparse:
        v_image[: HEIGHT // 2] = 0
        v_image[:, : WIDTH // 3] = 0
    return v_image


def tiles_of(seed: int) -> torch.Tensor:
    return torch.from_numpy(random_mask(seed).astype(np.bool_))


def same(got: list[torch.Tensor], want: list[torch.Tensor]) -> None:
    for one, other in zip(got, want, strict=True):
        assert torch.equal(one, other)


def found(result: LossAndGrad[Any]) -> list[torch.Tensor]:
    grad = [value for _, value in result.grad.items()] if isinstance(result.grad, Gaussians) else [result.grad]
    others = result.curvature, result.means2d, result.exposure
    return [result.loss.double(), *grad, *(value for value in others if value is not None)]


def rendered(output: RenderOutput) -> list[torch.Tensor]:
    return [value.detach() for value in (output.image, output.alpha, output.tiles) if value is not None]


def screen(session: RenderSession, view: int, v_image: torch.Tensor) -> list[torch.Tensor]:
    result, rows = session.screen_gradient(view, v_image), session.screen_gradient_rows(view, v_image)
    return [result.gradient, result.visible, rows.rows, rows.gradient]


class Sessions(RuleBasedStateMachine):
    """A session, the scene that it should have, and what it promised before."""

    @initialize(
        kind=st.sampled_from(sorted(KINDS)),
        budget=st.sampled_from(BUDGETS),
        seed=SEEDS,
        threads=st.integers(1, 3),
        isa=st.sampled_from(_native.supported_isas()),
        drawn=FLAGS,
    )
    def begin(self, kind: str, budget: float | None, seed: int, threads: int, isa: str, drawn: bool) -> None:
        set_num_threads(threads)
        _native.select_isa(isa)
        self.config = CpuRenderer.Config(cache_mb=budget)
        self.whole = built(kind, seed)
        self.active: torch.Tensor | None = None
        self.waiting: tuple[RenderOutput, Scene, Scene, int] | None = None
        self.former: tuple[RenderSession, Scene] | None = None
        self.session = CpuRenderer(self.config).open(self.whole, None, rig(), BACKGROUND)
        for view in (0, 1) if drawn else ():
            self.session.screen_gradient(view, image_gradient(seed, False))

    def anew(self) -> RenderSession:
        """A session without a budget."""
        return CpuRenderer().open(self.whole, self.active, rig(), BACKGROUND)

    def rows(self, amount: float, seed: int) -> Scene:
        return moved(self.whole if self.active is None else self.whole.rows(self.active), amount, seed)

    def compare(self, call: Callable[[RenderSession], list[torch.Tensor]]) -> list[torch.Tensor]:
        got = call(self.session)
        same(got, call(self.anew()))
        return got

    @rule(count=COUNTS, seed=SEEDS, ordered=FLAGS, further=FLAGS)
    def narrow(self, count: int, seed: int, ordered: bool, further: bool) -> None:
        """To other rows, or to some of those that are active."""
        among = torch.arange(len(self.whole)) if self.active is None or not further else self.active.sort().values
        self.active = among[chosen(len(among), min(count, 1 + len(among) // 2) if further else count, seed, ordered)]
        self.session.narrow(self.active)

    @rule(view=VIEWS, amount=AMOUNTS, seed=SEEDS, masked=FLAGS, later=FLAGS)
    def render(self, view: int, amount: float, seed: int, masked: bool, later: bool) -> None:
        """Also as the whole scene with these rows is rendered and differentiated."""
        mask = tiles_of(seed) if masked else None
        mine, theirs, rows = (leaves(self.rows(amount, seed)) for _ in range(3))
        probe, full_probe = (torch.zeros(len(each), 2, requires_grad=True) for each in (rows, self.whole))
        output, fresh = (
            self.session.render(view, mine, tile_mask=mask),
            self.anew().render(view, theirs, tile_mask=mask, probe=probe),
        )
        same(rendered(output), rendered(fresh))
        backpropagate(fresh, seed)
        everything = leaves(rows if self.active is None else replaced(self.whole, self.active, rows))
        open_wide = CpuRenderer().open(everything, None, rig(), BACKGROUND)
        full = open_wide.render(view, everything, tile_mask=mask, probe=full_probe)
        backpropagate(full, seed)
        inside = torch.from_numpy(masked_pixels(random_mask(seed))) if masked else torch.ones(HEIGHT, WIDTH) > 0
        assert torch.equal(output.image[inside], full.image[inside])
        assert torch.equal(output.alpha[inside], full.alpha[inside])
        ids = torch.arange(len(self.whole)) if self.active is None else self.active
        same([*grads(theirs), probe.grad], [value[ids] for value in (*grads(everything), full_probe.grad)])
        self.compare_outside(view, output, inside)
        if later:
            self.waiting = output, mine, theirs, seed
        else:
            backpropagate(output, seed)
            same(grads(mine), grads(theirs))

    def compare_outside(self, view: int, output: RenderOutput, inside: torch.Tensor) -> None:
        """Other tiles show the scene that the session was opened with, or the background of a session of all rows."""
        image = output.image.detach()
        if self.active is None:
            assert torch.equal(image[~inside], torch.tensor(BACKGROUND).expand(HEIGHT, WIDTH, 3)[~inside])
            return
        old = CpuRenderer().render(self.whole, rig(), view, BACKGROUND).image
        assert output.tiles is not None
        reached = torch.from_numpy(masked_pixels(output.tiles.numpy()))
        assert torch.equal(image[~(inside & reached)], old[~(inside & reached)])
        assert len(self.active) or not reached.any()

    @precondition(lambda self: self.waiting is not None)
    @rule()
    def differentiate_what_was_rendered_before(self) -> None:
        output, mine, theirs, seed = self.waiting
        self.waiting = None
        backpropagate(output, seed)
        same(grads(mine), grads(theirs))

    @rule(view=VIEWS, amount=AMOUNTS, seed=SEEDS, coloured=FLAGS, weighted=FLAGS, probe=FLAGS)
    def loss_by_rows(self, view: int, amount: float, seed: int, coloured: bool, weighted: bool, probe: bool) -> None:
        target = replace(comparison(coloured), tile_weights=some_tiles(seed) if weighted else None)
        rows = self.rows(amount, seed)
        self.compare(lambda session: found(session.loss_and_grad(view, target, WrtRows(rows, means2d=probe))))

    # For a view beyond the budget a session takes another body, equal up to rounding.
    @precondition(lambda self: self.active is not None and len(self.active) and self.config.cache_mb is None)
    @rule(view=VIEWS, seed=SEEDS, coloured=FLAGS, weighted=FLAGS, curvature=FLAGS)
    def loss_by_transforms(self, view: int, seed: int, coloured: bool, weighted: bool, curvature: bool) -> None:
        target = replace(comparison(coloured), tile_weights=some_tiles(seed) if weighted else None)
        rng, rows = np.random.default_rng(seed), self.rows(0.0, 0)
        place = np.arange(len(rows)) % 2
        given = GroupTransforms(np.arange(len(rows)), place, *(0.3 * rng.standard_normal((2, 3)) for _ in range(3)))
        wrt = WrtTransforms(rows, given.map(torch.from_numpy), curvature)
        self.compare(lambda session: found(session.loss_and_grad(view, target, wrt)))

    @precondition(lambda self: self.active is None)
    @rule(view=VIEWS, amount=AMOUNTS, seed=SEEDS, coloured=FLAGS)
    def loss_by_the_scene(self, view: int, amount: float, seed: int, coloured: bool) -> None:
        target, rows = comparison(coloured), self.rows(amount, seed)
        self.compare(lambda session: found(session.loss_and_grad(view, target, WrtScene(rows))))

    @rule(view=VIEWS, seed=SEEDS, sparse=FLAGS)
    def screen_gradient(self, view: int, seed: int, sparse: bool) -> None:
        """Also as the pass finds it that differentiates everything."""
        v_image = image_gradient(seed, sparse)
        gradient, visible, *_ = self.compare(lambda session: screen(session, view, v_image))
        rasterizer = (held := acquire_rasterizer(rig(), view, BACKGROUND)).rasterizer
        rasterizer.forward(SplatArrays(*(value.numpy() for _, value in self.whole.items())))
        assert np.array_equal(visible.nonzero()[:, 0], np.sort(rasterizer.visible_rows()))
        assert np.array_equal(gradient, rasterizer.backward(v_image.numpy()).means2d)
        del held

    @rule(view=VIEWS, seed=SEEDS)
    def visible(self, view: int, seed: int) -> None:
        both = torch.stack([tiles_of(seed), tiles_of(seed + 1)])
        self.compare(lambda session: [session.visible(view, both[0]), session.visible_anywhere(both)])

    @rule(count=COUNTS, amount=AMOUNTS, seed=SEEDS, ordered=FLAGS, narrowed=FLAGS)
    def commit(self, count: int, amount: float, seed: int, ordered: bool, narrowed: bool) -> None:
        """Rows that were active or not; a frame begins with the rows that change in it."""
        ids = chosen(len(self.whole), count, seed, ordered)
        after = replaced(self.whole, ids, moved(self.whole.rows(ids), amount, seed))
        self.former = self.session, self.whole
        self.session, self.whole = self.session.commit(after, ids), after
        self.active = self.waiting = None
        if narrowed:
            self.narrow(count, seed + 1, ordered=True, further=False)

    @precondition(lambda self: self.former is not None)
    @rule(view=VIEWS, seed=SEEDS)
    def look_at_the_session_before(self, view: int, seed: int) -> None:
        session, whole = self.former
        fresh = CpuRenderer().open(whole, None, rig(), BACKGROUND)
        same(*(screen(each, view, image_gradient(seed, False)) for each in (session, fresh)))

    @rule(view=VIEWS, seed=SEEDS, how=st.sampled_from(["commit", "render", "loss"]))
    def refuse_a_value_that_is_not_finite(self, view: int, seed: int, how: str) -> None:
        every = torch.arange(len(self.whole))
        rows = (self.whole if how == "commit" else self.rows(0.0, 0)).map(torch.clone)
        if not len(rows) or (how == "commit" and not self.session.cache_bytes().per_view):
            return  # nothing to refuse, or no cache that would be brought to the next scene
        rows.means[seed % len(rows), 1] = torch.nan
        calls: dict[str, Callable[[], object]] = {
            "commit": lambda: self.session.commit(rows, every),
            "render": lambda: self.session.render(view, rows),
            "loss": lambda: self.session.loss_and_grad(view, comparison(), WrtRows(rows)),
        }
        with pytest.raises(ValueError, match="means: expected finite values, got nan"):
            calls[how]()
        self.waiting = None if how == "commit" else self.waiting

    @invariant()
    def caches_keep_to_the_budget(self) -> None:
        if self.config.cache_mb is not None:
            assert self.session.cache_bytes().total <= self.config.cache_mb * 1e6

    def teardown(self) -> None:
        if not hasattr(self, "session"):
            return
        self.compare_everything()

    def compare_everything(self) -> None:
        """A frame as a stream makes it: rows that change, other ones, a commit."""
        for other in (False, True):
            if self.active is None or other:
                self.narrow(20 if self.active is None else len(self.active), 5, ordered=True, further=False)
            for view in (0, 1):
                self.screen_gradient(view, view, False)
                self.loss_by_rows(view, 0.3, view, False, False, False)
                self.render(view, 0.3, view, view == 1, False)
        self.render(0, 0.3, 2, False, True)
        self.render(0, 0.02, 3, True, False)
        self.differentiate_what_was_rendered_before()
        self.commit(20, 0.3, 4, ordered=False, narrowed=True)
        self.look_at_the_session_before(0, 1)
        for view in (0, 1):
            self.render(view, 0.3, view, False, False)
            self.screen_gradient(view, view, False)


def test_a_session_after_any_calls_is_one_opened_anew() -> None:
    run_state_machine_as_test(
        Sessions,
        settings=settings(max_examples=50, stateful_step_count=12, suppress_health_check=[HealthCheck.too_slow]),
    )


def test_many_commits_without_looking() -> None:
    """Tile lists that grow and shrink again and again are moved and packed; nothing is lost."""
    subject = Sessions()
    subject.begin("sparse", None, 3, 1, _native.active_isa(), drawn=True)
    start = subject.whole
    tight = replace(start, means=start.means * 0.1)
    for frame in range(60):
        ids = chosen(len(start), len(start) // 2, frame)
        subject.whole = replaced(subject.whole, ids, (tight if frame % 2 else start).rows(ids))
        subject.session = subject.session.commit(subject.whole, ids)
    subject.compare_everything()
