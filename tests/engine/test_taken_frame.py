"""A frame 0 of another stream: it keeps its grid and its units, and leaves its coordinates behind."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from similar_worlds import world

from gsstream.core.errors import OutputError
from gsstream.core.frame import Frame, PointCloud
from gsstream.core.world import IDENTITY
from gsstream.discovery.catalog import load_catalog
from gsstream.encode import Encoder, assemble, encoder_for, open_recording, recipe_for
from gsstream.engine.frame0.points import gather_points
from gsstream.engine.frame0.reproject import to_stream_coordinates
from gsstream.packet import KeyState, PlayerState, StreamWriter, decode_packet, encode_key
from gsstream.player.render import render

WORLD = "synthetic:frames=2&views=3&width=32&height=24&supersample=1"
TINY: Mapping[str, Any] = {
    "first_frame.max_iterations": 12,
    "first_frame.max_points": 250,
    "stream.epochs": 1,
}


def begun(method: str, settings: Mapping[str, Any] | None = None, first: PlayerState | None = None) -> PlayerState:
    with open_recording(WORLD) as source:
        parts = assemble(recipe_for(method, {**TINY, **(settings or {})}), load_catalog())
        frame = source.frame(0)

        def seeds(given: Frame) -> PointCloud:
            return gather_points(source, given, parts.recipe.first_frame)

        return Encoder(parts, source.info, seeds, first_frame=first).encode(frame).state.player


@cache
def original() -> PlayerState:
    return begun("s2gs-edge")


@pytest.mark.parametrize("settings", [{}, {"stream.epochs": 4, "gate.levels": 1}])
def test_the_same_octree_is_kept_bit_for_bit(settings: Mapping[str, Any]) -> None:
    """Laying it anew around the decoded centres would give other cells: so it once was, 14 % smaller ones."""
    first, taken = original(), begun("s2gs-fast", settings, original())
    assert taken.meta.extra["origin"] == first.meta.extra["origin"]
    for name in ("units", "unit_of", "node_counts"):
        np.testing.assert_array_equal(getattr(taken.layout, name), getattr(first.layout, name), strict=True)
    np.testing.assert_array_equal(taken.gaussians.means, first.gaussians.means, strict=True)


def test_other_groups_on_the_same_grid_keep_its_units() -> None:
    first = original()
    single = begun("s2gs-edge", {"structure.grouping": "gaussian"}, first)
    assert len(single.layout.node_counts) == len(first.gaussians)
    np.testing.assert_array_equal(single.layout.units, first.layout.units, strict=True)
    finer = begun("s2gs-edge", {"structure.gate_level": 1}, first)
    assert len(finer.layout.node_counts) > len(first.layout.node_counts)
    np.testing.assert_array_equal(finer.layout.units, first.layout.units, strict=True)


def test_flat_rows_of_a_table_measure_in_the_units_of_the_octree() -> None:
    first, flat = original(), begun("dense", first=original())
    np.testing.assert_array_equal(flat.layout.units, first.layout.units, strict=True)
    assert np.bincount(flat.layout.unit_of).tolist() == np.bincount(first.layout.unit_of).tolist()


def test_a_flat_structure_may_measure_in_the_rig_whoever_made_frame_0() -> None:
    """Rates count in that length: of two frames 0 the better was three decibels worse (docs/results/methods.md)."""
    rig = {"structure.unit": "rig", "structure.resolution": 150}
    own, taken = begun("dense", rig), begun("dense", rig, original())
    np.testing.assert_array_equal(own.layout.units, taken.layout.units, strict=True)
    assert own.layout.units.tolist() != original().layout.units.tolist()


@pytest.mark.parametrize("settings", [{"structure.root_exponent": 6}, {"structure.log_base": 3.0}])
def test_an_octree_of_other_settings_lays_its_own_grid(settings: Mapping[str, Any]) -> None:
    first, other = original(), begun("s2gs-edge", settings, original())
    assert other.layout.units.tolist() != first.layout.units.tolist()


def test_an_octree_lays_its_grid_on_a_scene_that_had_none() -> None:
    flat = begun("dense")
    assert len(begun("s2gs-edge", first=flat).layout.units) > len(flat.layout.units)


SOURCE = "synthetic:frames=2&views=3&width=32&height=24&supersample=1"
SMALL = {
    "first_frame.max_iterations": 12,
    "first_frame.max_points": 250,
    "stream.epochs": 1,
    "first_frame.points": "recording",
}


@cache
def first(method: str = "s2gs-edge") -> PlayerState:
    with open_recording(SOURCE) as source:
        return decode_packet(None, encoder_for(method, source, SMALL).encode(source.frame(0)).packet.data)


def stream_of(player: PlayerState, path) -> None:
    with StreamWriter.open(path) as writer:
        writer.append(encode_key(KeyState(player.gaussians, player.layout, player.meta)))


def test_a_scene_of_other_coordinates_is_brought_into_those_of_the_run():
    player, where = first(), world(30.0, (4.0, -7.0, 2.0), turn=4)
    own = player.meta
    theirs = replace(own, world=own.world.after(where.inverse()), train=where.cameras(own.train))
    scene = where.gaussians(player.gaussians).map(lambda values: np.asarray(values, np.float32))
    layout = replace(player.layout, units=np.float32(30.0) * player.layout.units)
    foreign = replace(player, scene=replace(player.scene, gaussians=scene, layout=layout), meta=theirs)
    taken = to_stream_coordinates(foreign, player.meta.world)
    assert taken.layout.units == pytest.approx(player.layout.units, rel=1e-5)
    assert taken.meta.train.viewmats == pytest.approx(player.meta.train.viewmats, abs=1e-9)
    pictures = [render(s.gaussians, player.meta.train, 1, renderer=None) for s in (player, taken)]
    assert pictures[0].std() > 0.03
    assert np.abs(pictures[0] - pictures[1]).max() < 0.01
    assert to_stream_coordinates(player, player.meta.world) is player


def test_a_stream_of_other_coordinates_is_not_continued(tmp_path):
    player = first()
    stream_of(replace(player, meta=replace(player.meta, world=IDENTITY)), tmp_path / "s.gss")
    with open_recording(SOURCE) as source, pytest.raises(OutputError, match="other coordinates"):
        encoder_for("s2gs-edge", source, SMALL).resume(tmp_path / "s.gss", source.frame)
