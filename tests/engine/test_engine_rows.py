"""Encoder state while Gaussians are added and removed, and levels of progressive training."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gsstream.core.changes import AddedGaussians, Delta, Residual, RowEdit
from gsstream.core.hierarchy import Hierarchy
from gsstream.core.rng import Rng
from gsstream.engine.state.stream_state import StreamState, next_state
from gsstream.engine.step.optimise import current_level, level_schedule
from gsstream.packet import decode_packet, encode_delta, encode_key
from gsstream.parts.backend.adam import ReferenceAdam
from gsstream.parts.motion.none import Still
from gsstream.parts.residual.adam_state import RowParameters, TopologyEdit
from gsstream.recipe.model import Stream
from gsstream.testing.packet import tiny_key
from tests.scenes import make_scene


@pytest.fixture
def state() -> StreamState:
    player = decode_packet(None, encode_key(tiny_key()).data)
    nodes = len(player.layout.node_counts)
    parent = torch.tensor([0] * 3 + [0] * (nodes - 3))
    parent[1:3] = torch.tensor([1, 2])
    level = (parent != torch.arange(nodes)).long()
    hierarchy = Hierarchy(torch.from_numpy(player.layout.node_of), parent, level)
    return StreamState(player, hierarchy, None, {"sh0": torch.ones(2, 3)})


def step(state: StreamState, delta: Delta) -> StreamState:
    player = state.player
    packet = encode_delta(delta, player.layout, player.decoders, frame=player.frame + 1)
    return next_state(Still(), state, decode_packet(player, packet.data), Rng(0))


def delta_of(births: AddedGaussians | None, deaths: list[int] | None = None) -> Delta:
    return Delta((RowEdit(births, np.array(deaths or [], np.int64)),))


def test_the_forest_grows_with_the_packet(state):
    nodes = len(state.player.layout.node_counts)
    # Two new nodes: one below node 4 (which is below node 0), one below that one, and a new root.
    parents = np.array([4, nodes, nodes + 2])
    added = AddedGaussians(make_scene(4), np.array([2, nodes, nodes + 1, nodes + 2]), np.zeros(4, np.uint8), parents)
    after = step(state, delta_of(added, [0, 7]))
    after.hierarchy.validate()
    assert after.hierarchy.num_gaussians == len(after.player.gaussians) == 42
    assert after.hierarchy.level.tolist()[nodes:] == [2, 3, 0]
    assert after.hierarchy.parent.tolist()[nodes:] == [4, nodes, nodes + 2]
    assert np.array_equal(after.hierarchy.node_of.numpy(), after.player.layout.node_of)
    assert torch.equal(after.hierarchy.parent[:nodes], state.hierarchy.parent)


def test_a_packet_without_births_leaves_the_forest_alone(state):
    gates = np.ones(len(state.player.layout.node_counts), np.uint8)
    symbols = {"opacities": np.ones((40, 1), np.int32)}
    after = step(state, Delta((Residual(gates, 1, symbols, {"opacities": 0.1}),)))
    assert after.hierarchy is state.hierarchy
    assert torch.equal(after.decoders["sh0"], torch.ones(2, 3))


def test_per_gaussian_moments_follow_the_edit():
    """Row 1 is copied as a fresh row, row 0 goes: what stays keeps its moment, what is fresh starts at zero."""
    table = RowParameters({"x": torch.arange(40.0)[:, None]}, {"x": 0.0}, ReferenceAdam())
    table.step({"x": torch.arange(40.0)[:, None] + 1})
    source = torch.cat([torch.arange(1, 40), torch.tensor([1])])
    fresh = torch.arange(40) == 39
    table.edit(TopologyEdit(source, fresh))
    moments = table.moments("x")["exp_avg"][:, 0]
    torch.testing.assert_close(moments[:39], 0.1 * (source[:39] + 1.0))
    assert moments[39] == 0
    assert table["x"][:, 0].tolist() == source.tolist()


PROGRESSIVE = Stream(progressive=True)


def units(*counts: int) -> np.ndarray:
    return np.repeat(np.arange(len(counts)), counts).astype(np.uint8)


def waiting_share(unit_of: np.ndarray, fraction: float) -> float:
    schedule = level_schedule(PROGRESSIVE, unit_of)
    return float((unit_of > current_level(schedule, fraction)).mean()) if schedule else 0.0


def test_empty_levels_are_not_counted() -> None:
    """Anchors per level as counted in a run: counting all eight, the schedule would begin at a level that is empty."""
    rows = units(148, 161, 54, 32, 2, 0, 0, 0)
    assert waiting_share(rows, 0.0) == pytest.approx(34 / 397)
    assert level_schedule(PROGRESSIVE, rows) == level_schedule(PROGRESSIVE, units(148, 161, 54, 32, 2))


def test_a_gap_between_levels_costs_no_stage() -> None:
    schedule = level_schedule(PROGRESSIVE, units(5, 0, 0, 4, 3))
    assert [level for _, level in schedule] == [3, 4]


def test_stages_grow_by_omega_and_all_take_part_at_the_end() -> None:
    schedule = level_schedule(PROGRESSIVE, units(1, 1, 1, 1, 1, 1))
    ends = [end for end, _ in schedule]
    assert [level for _, level in schedule] == [3, 4, 5]
    assert np.diff([0.0, *ends]) == pytest.approx(np.array([1, 1.5, 2.25]) / 4.75)
    assert waiting_share(units(1, 1, 1, 1, 1, 1), 1 - 1e-12) == 0


@pytest.mark.parametrize("rows", [units(7), units(0, 0, 7), np.zeros(0, np.uint8)])
def test_nothing_waits_where_there_is_one_level(rows: np.ndarray) -> None:
    assert level_schedule(PROGRESSIVE, rows) == ()


def test_off_unless_the_recipe_asks() -> None:
    assert level_schedule(Stream(), units(1, 1, 1, 1)) == ()
