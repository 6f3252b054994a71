"""The octree at the extremes: no key overflows, no point is lost, nothing leaves its cell."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from gsstream_s2gs import morton
from gsstream_s2gs.octree import StreamingOctree
from hypothesis import given
from hypothesis import strategies as st
from numeric_scenes import blobs, camera, some

from gsstream.core.errors import GsstreamError
from gsstream.core.frame import PointCloud
from gsstream.parts.structure.base import Anchors


def cloud(xyz: object) -> PointCloud:
    points = np.asarray(xyz, np.float32).reshape(-1, 3)
    return PointCloud(points, np.full_like(points, 0.5), "test")


def octree(**settings: object) -> StreamingOctree:
    return StreamingOctree(StreamingOctree.Config(**settings))


def assert_covers(points: PointCloud, anchors: Anchors) -> None:
    """Finite, and every point lies in the root cell of some anchor, up to float32 spacing at its coordinates."""
    for value in (anchors.positions, anchors.cell_sizes, anchors.origin):
        assert bool(torch.isfinite(value).all())
    roots = anchors.positions[anchors.levels == 0].double()
    gap = (torch.from_numpy(points.xyz).double()[:, None] - roots[None]).abs().amax(2).amin(1)
    reach = max(np.abs(points.xyz).max(), anchors.origin.abs().max().numpy())
    spacing = float(np.spacing(reach))
    assert float(gap.max()) <= 0.5 * float(anchors.cell_sizes[0]) + 2 * spacing


SHAPES = {
    "coincident": np.zeros((20, 3)),
    "collinear": np.linspace(-1, 1, 30)[:, None] * np.ones(3),
    "along an axis": np.linspace(-1, 1, 30)[:, None] * [1.0, 0, 0],
    "coplanar": np.stack([*np.meshgrid(np.linspace(-1, 1, 8), np.linspace(-1, 1, 8)), np.zeros((8, 8))], -1),
    "two points": [[0, 0, 0], [1, 1, 1]],
}


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("offset", [0.0, 1e7])
@pytest.mark.parametrize("shape", SHAPES)
def test_degenerate_clouds_of_any_size_anywhere(shape: str, offset: float, size: float) -> None:
    points = cloud(np.asarray(SHAPES[shape]) * size + offset)
    part = octree(root_exponent=4)
    anchors = part.seed(points, camera())
    assert_covers(points, anchors)
    scene = blobs(anchors.positions)
    hierarchy = part.build(scene, anchors)
    hierarchy.validate()
    if shape == "coincident":
        assert hierarchy.num_nodes == 1


@pytest.mark.parametrize("exponent", [1, 4, 8, 12])
def test_root_grids_of_the_paper_with_as_many_levels_as_fit(exponent: int) -> None:
    part = octree(root_exponent=exponent, max_levels=22 - exponent, visible_threshold=0.0, log_base=1.05)
    rng = np.random.default_rng(exponent)
    points = cloud(np.concatenate([rng.uniform(-1, 1, (40, 3)), [[0, 0, -2.9999999]]]))
    anchors = part.seed(points, camera())
    assert int(anchors.levels.max()) == 21 - exponent, "the finest level that a key can hold is reached"
    assert_covers(points, anchors)
    with pytest.raises(ValueError, match=r"expected at most 22|less than or equal to 21"):
        octree(root_exponent=exponent, max_levels=23 - exponent)


@given(st.lists(st.tuples(*[st.integers(0, 2**21 - 1)] * 3), min_size=1, max_size=20))
@some(100)
def test_keys_hold_21_bits_per_axis_without_overflow(cells: list[tuple[int, int, int]]) -> None:
    keys = morton.encode(torch.tensor(cells))
    places = [(bit, axis) for bit in range(21) for axis in range(3)]
    expected = [sum(((cell[axis] >> bit) & 1) << (3 * bit + axis) for bit, axis in places) for cell in cells]
    assert keys.tolist() == expected
    assert max(expected) < 2**63
    assert morton.decode(keys).tolist() == [list(c) for c in cells]
    assert torch.equal(morton.encode(torch.tensor(cells) >> 1), keys >> 3)


@pytest.mark.parametrize("padding", [0.0, 0.05])
def test_a_point_on_every_border_of_every_cell(padding: float) -> None:
    grid = np.stack(np.meshgrid(*[np.arange(9.0)] * 3), -1).reshape(-1, 3)
    part = octree(root_exponent=3, max_levels=1, padding=padding)
    anchors = part.seed(cloud(grid), camera())
    assert len(anchors.positions) == 8**3
    hierarchy = part.build(blobs(grid), anchors)
    counts = torch.bincount(hierarchy.node_of)
    assert int(counts.sum()) == 9**3
    if padding == 0:
        # A border belongs to the cell above it; what lies on the far faces of the cube has root cells of its own.
        assert hierarchy.num_nodes == 9**3


@pytest.mark.parametrize("shift", [2.0**19, 2.0**21, 1e30])
def test_gaussians_that_fled_share_outermost_cells_and_overflow_nothing(shift: float) -> None:
    part = octree(root_exponent=1, max_levels=1)
    anchors = part.seed(cloud([[0, 0, 0], [1, 1, 1]]), camera())
    means = torch.tensor([[0.1, 0.1, 0.1], [shift, 0, 0], [-shift, 0, 0], [2 * shift, 0, 0]])
    hierarchy = part.build(blobs(means), anchors)
    hierarchy.validate()
    nodes = hierarchy.node_of.tolist()
    assert len({nodes[0], nodes[1], nodes[2]}) == 3
    assert (nodes[1] == nodes[3]) == (shift >= 2.0**20)


@given(
    st.lists(st.tuples(*[st.floats(-1, 1, width=32)] * 3), min_size=1, max_size=12),
    st.integers(-18, 20),
    st.floats(-1e7, 1e7, width=32),
)
@some(40)
def test_every_point_has_its_anchor(points: list[tuple[float, float, float]], power: int, offset: float) -> None:
    given_points = cloud(np.float32(2.0**power) * np.array(points, np.float32) + np.float32(offset))
    anchors = octree(root_exponent=6, max_levels=4).seed(given_points, camera())
    assert_covers(given_points, anchors)


def test_extents_that_vanish_or_overflow_in_float32_are_refused_not_garbled() -> None:
    """Cells of the one are 0 in float32, the cube of the other is infinite."""
    for size in (1e-44, 3e38):
        with pytest.raises(GsstreamError, match=r"cells vanish|its cube leaves float32"):
            octree().seed(cloud([[-size, 0, 0], [size, 0, 0]]), camera())
