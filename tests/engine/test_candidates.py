"""Who may change in a frame: candidates, changed rows and released rows against loops over rows, views and nodes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import Field

from gsstream.core.cameras import Cameras
from gsstream.core.hierarchy import Hierarchy
from gsstream.core.part import PartConfig
from gsstream.engine.fit.gates import TrainedGates
from gsstream.engine.step.frame_step import candidates
from gsstream.parts.backend.adam import ReferenceAdam
from gsstream.parts.backend.base import ScatterSession
from gsstream.parts.backend.change import Change
from gsstream.parts.backend.reference import ReferenceRenderer
from gsstream.parts.gate.base import GateSampler
from gsstream.parts.regularizer.none import NoRegularizer
from gsstream.parts.render.activations import rotation_matrices
from gsstream.parts.render.images import TILE
from gsstream.parts.render.session import RenderSession
from gsstream.testing.cases import BLACK, scene

WIDTH, HEIGHT, FOCAL = 56, 40, 40.0


def rig(views: int) -> Cameras:
    """Cameras on a line, looking along z; the picture is no multiple of a tile."""
    viewmats = np.tile(np.eye(4), (views, 1, 1))
    viewmats[:, 0, 3] = np.linspace(-0.8, 0.8, views)
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    ids = tuple(f"cam{i}" for i in range(views))
    return Cameras(ids, viewmats, np.tile(K, (views, 1, 1)), WIDTH, HEIGHT)


class SaidToBeSeen:
    """A session that sees what it is told to; it remembers which views it was asked about."""

    visible_anywhere = RenderSession.visible_anywhere

    def __init__(self, seen: torch.Tensor) -> None:
        self.seen, self.asked = seen, list[int]()

    def visible(self, view: int, tiles: torch.Tensor) -> torch.Tensor:
        assert tiles.any(), "a view without a changed tile shows nothing that changed"
        self.asked.append(view)
        return self.seen[view]


def votes_by_hand(mean: Sequence[float], tiles: torch.Tensor, cameras: Cameras) -> float:
    """Share of the views with this centre in the picture in which its tile, or one of eight around it, changed."""
    hits = views = 0
    rows, columns = tiles.shape[1:]
    for view in range(len(cameras)):
        x, y, z = cameras.viewmats[view][:3, :3] @ mean + cameras.viewmats[view][:3, 3]
        if z <= cameras.near_plane:
            continue
        u, v = FOCAL * x / z + WIDTH / 2, FOCAL * y / z + HEIGHT / 2
        if not (0 <= u < WIDTH and 0 <= v < HEIGHT):
            continue
        views += 1
        row, column = int(v // TILE), int(u // TILE)
        around = [(row + i, column + j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
        hits += any(0 <= i < rows and 0 <= j < columns and bool(tiles[view, i, j]) for i, j in around)
    return hits / views if views else 0.0


@settings(max_examples=60, deadline=None)
@given(views=st.integers(1, 4), seed=st.integers(0, 999), share=st.sampled_from([0.0, 0.1, 0.4, 1.0]), data=st.data())
def test_changed_rows_are_those_seen_in_changed_tiles_with_enough_votes(
    views: int, seed: int, share: float, data: Any
) -> None:
    rng = np.random.default_rng(seed)
    # Some lie behind the cameras and some beside every picture: they have no vote.
    means = rng.uniform([-4, -3, -1], [4, 3, 6], (30, 3)).astype(np.float32)
    tiles = torch.from_numpy(rng.random((views, -(-HEIGHT // TILE), -(-WIDTH // TILE))) < share)
    session = SaidToBeSeen(torch.from_numpy(rng.random((views, 30)) < 0.6))
    least = data.draw(st.sampled_from([0.0, 0.3, 0.5, 0.99]))
    cameras = rig(views)
    found = Change(tiles, HEIGHT, WIDTH).rows(torch.from_numpy(means), cameras, session, least)
    changed = [view for view in range(views) if bool(tiles[view].any())]
    expected = [
        any(bool(session.seen[view, row]) for view in changed)
        and votes_by_hand(means[row].astype(np.float64), tiles, cameras) >= least
        for row in range(30)
    ]
    assert found.tolist() == expected
    assert session.asked == changed


@settings(max_examples=40, deadline=None)
@given(views=st.integers(1, 3), seed=st.integers(0, 999), share=st.sampled_from([0.1, 0.4]))
def test_the_ends_of_a_gaussian_are_those_of_its_longest_axis(views: int, seed: int, share: float) -> None:
    """The reference takes the axis from the covariance, so it does not know which scale is which."""
    rng = np.random.default_rng(seed)
    means = torch.from_numpy(rng.uniform([-2, -1.5, 1], [2, 1.5, 5], (20, 3)))
    scales, quats = torch.from_numpy(rng.normal(-1, 1, (20, 3))), torch.from_numpy(rng.normal(0, 1, (20, 4)))
    some = scene(means, scales=scales, quats=quats)
    tiles = torch.from_numpy(rng.random((views, -(-HEIGHT // TILE), -(-WIDTH // TILE))) < share)
    least = [0.25, 0.5, 1.0][seed % 3]
    able = torch.from_numpy(rng.random(20) < 0.7)
    found = Change(tiles, HEIGHT, WIDTH).within(able, some, rig(views), least)
    for row in range(20):
        turn = rotation_matrices(quats[row : row + 1])[0].numpy()
        variance, axes = np.linalg.eigh(turn @ np.diag(np.exp(2 * scales[row].numpy())) @ turn.T)
        reach = np.sqrt(variance[-1]) * axes[:, -1]
        ends = [votes_by_hand(means[row].numpy() + side * reach, tiles, rig(views)) for side in (1, -1)]
        assert bool(found[row]) == (bool(able[row]) and min(ends) >= least), row


def test_a_gaussian_that_reaches_far_beyond_what_changed_takes_no_part() -> None:
    """A round one of the same place does, and so does a long one that ends in what changed."""
    tiles = torch.zeros(3, 3, 4, dtype=torch.bool)
    tiles[:, 1, 1] = True
    long = torch.tensor([[0.0, 3.0, 0.0], [-4.0, -4.0, -4.0], [0.0, -1.5, 0.0]])
    some = scene(torch.tensor([[-0.1, 0.0, 3.0]] * 3), scales=torch.where(long == 0, torch.tensor(-4.0), long))
    able = torch.ones(3, dtype=torch.bool)
    assert Change(tiles, HEIGHT, WIDTH).within(able, some, rig(3), 1e-6).tolist() == [False, True, True]
    assert Change(tiles, HEIGHT, WIDTH).within(able, some, rig(3), 1.0).tolist() == [False, True, True]
    assert able.all(), "what was given stays"


@pytest.mark.parametrize("number", [0, 1])
def test_few_rows(number: int) -> None:
    tiles = torch.ones(2, 3, 4, dtype=torch.bool)
    session = SaidToBeSeen(torch.ones(2, number, dtype=torch.bool))
    means = torch.tensor([[0.0, 0.0, 2.0]])[:number]
    assert Change(tiles, HEIGHT, WIDTH).rows(means, rig(2), session, 1.0).tolist() == [True] * number


def test_what_is_seen_in_a_changed_tile_is_what_changes_its_pixels() -> None:
    """With a real session: taking a row away changes a pixel of a changed tile only if the row is in the result."""
    means = torch.from_numpy(np.random.default_rng(3).uniform([-1.2, -0.8, 1.5], [1.2, 0.8, 3], (25, 3))).float()
    gaussians, cameras = scene(means), rig(2)
    tiles = torch.zeros(2, 3, 4, dtype=torch.bool)
    tiles[0, 1, 1] = tiles[1, 0, 3] = True
    renderer = ReferenceRenderer()
    session = ScatterSession(renderer, gaussians, None, cameras, BLACK)
    found = Change(tiles, HEIGHT, WIDTH).rows(means, cameras, session, 0.0)
    for row in range(25):
        less = gaussians.rows(torch.tensor([other for other in range(25) if other != row]))
        changes = False
        for view in range(2):
            with torch.no_grad():
                ours, theirs = (renderer.render(some, cameras, view, BLACK).image for some in (gaussians, less))
            differs = Change(tiles, HEIGHT, WIDTH).only_changed(view, (ours - theirs).abs())
            changes |= bool(differs.max() > 1e-6)
        # A row that lies behind opaque ones is seen by the session and changes nothing: never the other way round.
        assert bool(found[row]) or not changes, row
    assert 0 < int(found.sum()) < 25, "a rig that sees all or nothing proves nothing"


@given(nodes=st.integers(1, 6), rows=st.integers(0, 20), seed=st.integers(0, 999), threshold=st.sampled_from([0, 0.25]))
def test_candidates_changed_and_have_a_gate_that_may_open(nodes: int, rows: int, seed: int, threshold: float) -> None:
    rng = np.random.default_rng(seed)
    node_of, changed = rng.integers(0, nodes, rows), rng.random(rows) < 0.5
    # Also exactly the threshold: a gate that opens with this probability and no more is left out.
    chance = rng.choice([0.0, 0.25, 0.250001, 1.0], nodes)
    hierarchy = flat(node_of, nodes)
    found = candidates(torch.from_numpy(changed), torch.from_numpy(chance), hierarchy, threshold)
    assert found.tolist() == [row for row in range(rows) if changed[row] and chance[node_of[row]] > threshold]
    assert found.dtype == torch.int64


class AsGiven(GateSampler):
    """A gate is its logit."""

    source = "test"

    class Config(PartConfig):
        levels: int = Field(description="levels of a gate")

    @property
    def num_levels(self) -> int:
        return self.config.levels

    def init(self, logits: torch.Tensor) -> torch.Tensor:
        return logits

    def noise(self, num_nodes: int, generator: torch.Generator) -> None:
        return None

    def sample(self, logits: torch.Tensor, noise: torch.Tensor | None) -> torch.Tensor:
        return logits

    def open_probability(self, logits: torch.Tensor) -> torch.Tensor:
        return logits

    def bound(self, logits: torch.Tensor) -> torch.Tensor:
        return logits


@given(nodes=st.integers(1, 6), rows=st.integers(0, 20), seed=st.integers(0, 999), levels=st.sampled_from([1, 10, 255]))
def test_a_gate_that_rounds_to_closed_is_closed_for_its_rows(nodes: int, rows: int, seed: int, levels: int) -> None:
    """Before and after some of the rows leave."""
    rng = np.random.default_rng(seed)
    node_of = rng.integers(0, nodes, rows)
    values = rng.choice([0.0, 0.4 / levels, 0.6 / levels, 1.0], nodes)
    opened = np.array([round(values[node] * levels) > 0 for node in node_of], bool)
    gates = TrainedGates(
        gate=AsGiven(AsGiven.Config(levels=levels)),
        regularizer=NoRegularizer(),
        optimiser=ReferenceAdam(),
        lr=0.1,
        logits=torch.from_numpy(values),
        hierarchy=flat(node_of, nodes),
        rows=torch.arange(rows),
        generator=torch.Generator(),
    )
    assert gates.opened()[gates.node_of].tolist() == opened.tolist()
    some = np.flatnonzero(rng.random(rows) < 0.5)
    gates.select_rows(torch.from_numpy(some))
    assert gates.opened()[gates.node_of].tolist() == opened[some].tolist()
    assert gates.all_logits().tolist() == values.tolist()


def flat(node_of: Any, nodes: int) -> Hierarchy:
    """Roots alone."""
    roots = torch.arange(nodes)
    return Hierarchy(torch.from_numpy(node_of).long(), roots, torch.zeros_like(roots))
