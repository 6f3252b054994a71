"""A frame 0 that is taken over keeps its grid, so that both streams measure, gate and step in the same units."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

import numpy as np
import pytest

from gsstream.core.frame import Frame, PointCloud
from gsstream.encode import Encoder, assemble, open_recording, recipe_for
from gsstream.engine.frame0.points import gather_points
from gsstream.packet import PlayerState
from gsstream.plugins.catalog import load_catalog

WORLD = "synthetic:frames=2&views=3&width=32&height=24&supersample=1"
TINY: Mapping[str, Any] = {
    "first_frame.max_iterations": 12, "first_frame.max_points": 250, "stream.epochs": 1,
}  # fmt: skip


def begun(method: str, settings: Mapping[str, Any] | None = None, first: PlayerState | None = None) -> PlayerState:
    with open_recording(WORLD) as source:
        parts = assemble(recipe_for(method, {**TINY, **(settings or {})}), load_catalog())
        frame = source.frame(0)

        def seeds(given: Frame) -> PointCloud:
            return gather_points(source.points, given, parts.recipe.first_frame)

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


@pytest.mark.parametrize("settings", [{"structure.root_exponent": 6}, {"structure.log_base": 3.0}])
def test_an_octree_of_other_settings_lays_its_own_grid(settings: Mapping[str, Any]) -> None:
    first, other = original(), begun("s2gs-edge", settings, original())
    assert other.layout.units.tolist() != first.layout.units.tolist()


def test_an_octree_lays_its_grid_on_a_scene_that_had_none() -> None:
    flat = begun("dense")
    assert len(begun("s2gs-edge", first=flat).layout.units) > len(flat.layout.units)
