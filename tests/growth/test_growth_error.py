"""Growth where views stay wrong: where newborn Gaussians are placed, who is kept, and that their number is constant."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from gsstream.core.changes import Scene, apply_rows
from gsstream.core.frame import Frame
from gsstream.core.gaussians import Gaussians
from gsstream.core.hierarchy import Hierarchy
from gsstream.core.rng import Rng
from gsstream.engine.fit.exposure import Exposure
from gsstream.engine.step.active.change import detect_change
from gsstream.engine.step.context import FrameView
from gsstream.growth.error import OUT_OF, ErrorGrowth
from gsstream.growth.judging import error_map
from gsstream.growth.placing import placed
from gsstream.growth.splitting import halves, stretched
from gsstream.source.synthetic import SyntheticOptions, SyntheticSource
from gsstream.testing.stepping import MethodUnderTest

VIEWS, SIZE = 6, (96, 72)
#: By now the ball, which no camera saw at frame 0, has come down to where it stays.
NOW = 12


class Entered(NamedTuple):
    """A scene without the ball, and the frame in which it is there."""

    source: SyntheticSource
    method: MethodUnderTest
    scene: Scene
    before: Frame
    frame: Frame

    def work(self, exposure: Exposure | None = None, frame: Frame | None = None) -> FrameView:
        """The frame at work on the scene."""
        method, now = self.method, frame or self.frame
        change = detect_change(self.before, now, 6.0)
        gaussians = self.scene.gaussians.map(torch.from_numpy)
        roots = torch.arange(len(self.scene.layout.node_counts))
        hierarchy = Hierarchy(torch.from_numpy(self.scene.layout.node_of), roots, torch.zeros_like(roots))
        return FrameView(method.parts, gaussians, hierarchy, now, self.before, exposure, change)


@pytest.fixture(scope="module")
def entered() -> Entered:
    options = SyntheticOptions(
        scene="enters", event=2, frames=NOW + 1, views=VIEWS, width=SIZE[0], height=SIZE[1], supersample=1,
        shadows=False,
    )  # fmt: skip
    source = SyntheticSource(options)
    before, points = source.frame(0), source.points()
    method = MethodUnderTest("dense")
    first = method.parts.recipe.first_frame.model_copy(update={"max_iterations": 120, "max_points": 4000})
    method.parts = replace(method.parts, recipe=method.parts.recipe.model_copy(update={"first_frame": first}))
    encoder = method.encoder()
    encoder.info = replace(source.info)
    encoder._seeds = lambda _: points
    state = encoder.encode(before).state
    frame = replace(source.frame(NOW), cameras=state.previous.cameras)
    return Entered(source, method, state.player.scene, state.previous, frame)


def distances(entered: Entered, points: np.ndarray) -> np.ndarray:
    """How far points are from the surface of the ball, metres."""
    return np.abs(np.linalg.norm(points - entered.source.object_positions(NOW)["ball"], axis=1) - 0.18)


def find(entered: Entered, work: FrameView):
    scene = entered.scene.gaussians.map(torch.from_numpy)
    maps = {view: error_map(work, scene, view, 10.0) for view in range(VIEWS)}
    means = entered.scene.gaussians.means
    return placed(
        work, maps, means, rays=60, depths=64, votes=0.6, agreement=0.1, generator=np.random.default_rng(0)
    )


def test_points_lie_on_what_entered(entered: Entered) -> None:
    found = find(entered, entered.work())
    assert len(found) > 60
    off = distances(entered, found.xyz)
    assert np.median(off) < 0.04  # a pixel is about 2.5 cm wide there
    assert np.mean(off < 0.1) > 0.8


def test_cameras_of_different_colour_response_find_the_same(entered: Entered) -> None:
    """Raw pictures of such cameras agree on no colour: compared so, nothing is ever born."""
    gains = np.linspace(0.6, 1.0, VIEWS).astype(np.float32)
    matrix = torch.stack([float(gain) * torch.eye(3) for gain in gains])
    exposure = Exposure(matrix, torch.zeros(VIEWS, 3))
    factors = gains[:, None, None, None]
    frame = replace(entered.frame, images=entered.frame.images * factors)
    lit = entered._replace(before=replace(entered.before, images=entered.before.images * factors))
    work = lit.work(exposure, frame)
    for view in range(VIEWS):
        assert np.allclose(work.scene_image(view).numpy(), entered.frame.images[view], atol=1e-5)
    plain, seen = find(entered, entered.work()), find(lit, work)
    assert len(seen) > 0.6 * len(plain)
    assert np.median(distances(entered, seen.xyz)) < 0.04


@pytest.fixture(scope="module")
def proposed(entered: Entered):
    part = ErrorGrowth(ErrorGrowth.Config(per_frame=96, split=4.0, growth=1.0))
    return part.propose(entered.scene, entered.work(), Rng(0))


def test_views_left_out_are_less_wrong_afterwards(entered: Entered, proposed) -> None:
    assert proposed is not None
    assert len(proposed.births) > 10
    after = apply_rows(entered.scene, proposed).gaussians.map(torch.from_numpy)
    before = entered.scene.gaussians.map(torch.from_numpy)
    work = entered.work()
    out = [view for view in range(VIEWS) if (view + work.index) % OUT_OF == 0]

    def wrong(scene: Gaussians[torch.Tensor]) -> float:
        return float(np.mean([(work.shown(scene, view) - work.image(view)).square().mean() for view in out]))

    assert wrong(after) < 0.95 * wrong(before)


def test_as_many_leave_as_join_and_those_that_leave_are_not_seen(entered: Entered) -> None:
    part = ErrorGrowth(ErrorGrowth.Config(per_frame=96, split=0.0, merges=False))
    work = entered.work()
    drawn = work.drawn_rows().numpy()
    faint = entered.scene.gaussians.opacities.copy()
    faint[:20] = -20.0  # these are drawn nowhere
    scene = replace(entered.scene, gaussians=replace(entered.scene.gaussians, opacities=faint))
    rows = part.propose(scene, entered._replace(scene=scene).work(), Rng(0))
    assert rows is not None
    assert len(rows.deaths) == len(rows.births) <= 20 + int((~drawn).sum())
    assert set(rows.deaths) <= {*range(20), *np.flatnonzero(~drawn)}


def test_a_birth_joins_the_node_and_unit_of_a_gaussian_of_its_colour(entered: Entered, proposed) -> None:
    layout = entered.scene.layout
    known = {(node, unit) for node, unit in zip(layout.node_of, layout.unit_of, strict=True)}
    born = proposed.births
    assert all(pair in known for pair in zip(born.nodes, born.unit_of, strict=True))


def test_halves_cover_what_their_parent_covered() -> None:
    rng = np.random.default_rng(1)
    number = 20
    parents = Gaussians(
        rng.normal(size=(number, 3)), rng.normal(size=(number, 4)), rng.normal(size=(number, 3)),
        rng.normal(size=number), rng.normal(size=(number, 1, 3)), np.zeros((number, 0, 3)),
    ).map(lambda value: value.astype(np.float32))  # fmt: skip
    both = halves(parents)
    for row in range(number):
        pair = [_covariance(both, 2 * row), _covariance(both, 2 * row + 1)]
        means = both.means[2 * row : 2 * row + 2].astype(np.float64)
        middle = means.mean(0)
        spread = np.mean([np.outer(m - middle, m - middle) for m in means], 0)
        whole = _covariance(parents, row)
        assert np.allclose(middle, parents.means[row], atol=1e-4)
        assert np.allclose(np.mean(pair, 0) + spread, whole, rtol=1e-3, atol=1e-4 * np.abs(whole).max())


def _covariance(gaussians: Gaussians[np.ndarray], row: int) -> np.ndarray:
    """R S S R^T by an independent route: the rotation from scipy."""
    w, x, y, z = gaussians.quats[row].astype(np.float64)
    turn = Rotation.from_quat([x, y, z, w]).as_matrix()
    return turn @ np.diag(np.exp(2.0 * gaussians.scales[row])) @ turn.T


def test_only_what_is_long_and_wrong_is_split(entered: Entered) -> None:
    work = entered.work()
    scene = entered.scene.gaussians.map(torch.from_numpy)
    maps = {view: error_map(work, scene, view, 10.0) for view in range(VIEWS)}
    assert not len(stretched(entered.scene.gaussians, work, maps, 0.0))
    rows = stretched(entered.scene.gaussians, work, maps, 2.0)
    assert len(rows)
    longest = np.exp(entered.scene.gaussians.scales).max(1)
    nearest = min(np.linalg.norm(entered.scene.gaussians.means[rows] - at, axis=1).min() for at in work.cameras.centers)
    assert longest[rows].min() > 2.0 * nearest / work.cameras.Ks[:, 0, 0].max() * 0.5
    right = {view: one._replace(wrong=torch.zeros_like(one.wrong)) for view, one in maps.items()}
    assert not len(stretched(entered.scene.gaussians, work, right, 2.0))


def test_nothing_is_born_with_two_views(entered: Entered) -> None:
    """One view would judge and one propose: nothing says how deep it is."""
    work = entered.work()
    two = replace(entered.frame, images=entered.frame.images[:2], cameras=work.cameras.select([0, 1]))
    before = replace(entered.before, images=entered.before.images[:2], cameras=two.cameras)
    assert ErrorGrowth().propose(entered.scene, entered._replace(before=before).work(frame=two), Rng(0)) is None


def test_where_all_are_seen_pairs_are_merged_and_views_left_out_are_less_wrong(entered: Entered) -> None:
    seen = np.flatnonzero(entered.work().drawn_rows().numpy())
    layout = entered.scene.layout
    node_of, nodes = layout.node_of[seen], len(layout.node_counts)
    counts = np.bincount(node_of, minlength=nodes).astype(np.int32)
    kept = replace(layout, node_counts=counts, unit_of=layout.unit_of[seen])
    crowded = entered._replace(scene=replace(entered.scene, gaussians=entered.scene.gaussians.rows(seen), layout=kept))
    work = crowded.work()
    for merges in (False, True):
        rows = ErrorGrowth(ErrorGrowth.Config(per_frame=96, split=0.0, merges=merges)).propose(
            crowded.scene, crowded.work(), Rng(0)
        )
        assert (rows is not None) == merges
    assert rows is not None
    assert len(rows.deaths) == len(rows.births) > 20
    after = apply_rows(crowded.scene, rows).gaussians.map(torch.from_numpy)
    before = crowded.scene.gaussians.map(torch.from_numpy)
    out = [view for view in range(VIEWS) if (view + work.index) % OUT_OF == 0]
    error = [
        np.mean([(work.shown(scene, view) - work.image(view)).square().mean() for view in out])
        for scene in (before, after)
    ]
    assert error[1] < 0.95 * error[0]
