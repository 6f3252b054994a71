"""The streaming octree of the paper: seeding, levels, weeding and regions, against plain loops."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch
from gsstream_s2gs.octree import StreamingOctree
from hypothesis import given, settings
from hypothesis import strategies as st
from s2gs_scene import gaussians, rig

from gsstream.api import Anchors, Cameras, Gaussians, InputError, PointCloud


def octree(**settings_: object) -> StreamingOctree:
    return StreamingOctree(StreamingOctree.Config(**({"root_exponent": 3, "max_levels": 6} | settings_)))


def cloud(n: int = 300) -> PointCloud:
    g = np.random.default_rng(0)
    return PointCloud((g.normal(size=(n, 3)) * 0.5).astype(np.float32), g.random((n, 3)).astype(np.float32), "test")


def placed(means: torch.Tensor) -> Gaussians[torch.Tensor]:
    n = len(means)
    return dataclasses.replace(gaussians(max(n, 1)).rows(slice(0, n)), means=means)


def grid(cell: float = 1.0) -> Anchors:
    none = torch.zeros(0, 3)
    sizes = torch.tensor([cell, cell / 2, cell / 4])
    return Anchors(none, none, torch.zeros(0, dtype=torch.int64), sizes, torch.zeros(3))


class TestSeed:
    def test_anchors_are_the_centres_of_occupied_cells(self) -> None:
        points = cloud()
        anchors = octree().seed(points, rig())
        xyz = torch.from_numpy(points.xyz).double()
        extent = float((xyz.amax(0) - xyz.amin(0)).max())
        assert float(anchors.cell_sizes[0]) * 2**3 == pytest.approx(1.1 * extent), "0.05 of it on either side"
        for level, size in enumerate(anchors.cell_sizes.double().tolist()):
            at = anchors.levels == level
            cells = (anchors.positions[at].double() - anchors.origin.double()) / size
            torch.testing.assert_close(cells.frac(), torch.full_like(cells, 0.5), atol=1e-3, rtol=0)
            mine = {tuple(c) for c in cells.floor().long().tolist()}
            occupied = {tuple(c) for c in ((xyz - anchors.origin) / size).floor().long().tolist()}
            assert len(mine) == int(at.sum())
            assert mine <= occupied
            assert level > 0 or mine == occupied

    def test_corner_option(self) -> None:
        centers, corners = octree().seed(cloud(), rig()), octree(anchor="corner").seed(cloud(), rig())
        level0 = int((centers.levels == 0).sum())
        half = (centers.positions[:level0] - corners.positions[:level0]) / centers.cell_sizes[0]
        torch.testing.assert_close(half, torch.full_like(half, 0.5), atol=1e-4, rtol=0)

    def test_colours(self) -> None:
        xyz = np.array([[0, 0, 0], [0.01, 0, 0], [1, 1, 1]], np.float32)
        rgb = np.array([[0.2, 0.8, 0], [0.4, 0.4, 0], [1, 0, 0.5]], np.float32)
        points = PointCloud(xyz, rgb, "test")
        mean, most = (octree(color=how, max_levels=1).seed(points, rig()).colors for how in ("mean", "max"))
        np.testing.assert_allclose(mean.numpy(), [[0.3, 0.6, 0], [1, 0, 0.5]], rtol=1e-6)
        np.testing.assert_allclose(most.numpy(), [[0.4, 0.8, 0], [1, 0, 0.5]], rtol=1e-6)

    @pytest.mark.parametrize("log_base", [1.2, 1.5, 2.0, 3.0])
    def test_number_of_levels(self, log_base: float) -> None:
        points, cameras = cloud(), rig()
        distances = np.linalg.norm(points.xyz[None] - cameras.centers[:, None], axis=2)
        pool = np.quantile(distances, [0.001, 0.999], axis=1).ravel()
        ratio = np.quantile(pool, 0.999) / np.quantile(pool, 0.001)
        wanted = round(math.log(ratio, log_base)) + 1
        found = octree(log_base=log_base, max_levels=19).seed(points, cameras)
        assert len(found.cell_sizes) == min(wanted, 19)
        np.testing.assert_allclose(found.cell_sizes[1:] / found.cell_sizes[:-1], 0.5)
        assert len(octree(log_base=log_base, max_levels=2).seed(points, cameras).cell_sizes) <= 2

    @pytest.mark.parametrize("rounding", ["floor", "round"])
    @pytest.mark.parametrize("threshold", [0.0, 0.5, 0.9])
    def test_weeding_against_a_plain_loop(self, rounding: str, threshold: float) -> None:
        points, cameras = cloud(), rig(5)
        part = octree(level_rounding=rounding, visible_threshold=threshold, log_base=1.3)
        kept = part.seed(points, cameras)
        everything = octree(level_rounding=rounding, visible_threshold=0.0, log_base=1.3)
        levels = len(kept.cell_sizes)
        distances = np.linalg.norm(points.xyz[None].astype(float) - cameras.centers[:, None], axis=2)
        far = np.quantile(np.quantile(distances, [0.001, 0.999], axis=1).ravel(), 0.999)
        expected = 0
        size = kept.cell_sizes.double().numpy()
        for level in range(levels):
            cells = np.unique(np.floor((points.xyz - kept.origin.double().numpy()) / size[level]), axis=0)
            for center in kept.origin.double().numpy() + (cells + 0.5) * size[level]:
                asked = np.log(far / np.linalg.norm(center - cameras.centers, axis=1)) / math.log(1.3)
                asked = np.clip(np.floor(asked) if rounding == "floor" else np.round(asked), 0, levels - 1)
                expected += level == 0 or (level <= asked).mean() > threshold
        assert len(kept.positions) == expected
        assert len(everything.seed(points, cameras).positions) >= expected

    def test_order_of_points_and_cameras_does_not_matter(self) -> None:
        points, cameras = cloud(), rig()
        order = np.random.default_rng(1).permutation(len(points))
        a = octree().seed(points, cameras)
        b = octree().seed(PointCloud(points.xyz[order], points.rgb[order], "x"), cameras.select([1, 2, 0]))
        assert torch.equal(a.positions, b.positions)
        assert torch.equal(a.levels, b.levels)
        torch.testing.assert_close(a.colors, b.colors)

    def test_a_point_at_a_camera(self) -> None:
        """Distance 0 asks for infinitely many levels; the cap answers, nothing is infinite or undefined."""
        cameras = rig(1)
        points = PointCloud(
            np.r_[cameras.centers, np.zeros((5, 3))].astype(np.float32), np.ones((6, 3), np.float32), "t"
        )
        at_camera = dataclasses.replace(cameras, viewmats=cameras.viewmats.copy())
        anchors = octree(distance_quantile=1.0, anchor="corner").seed(points, at_camera)
        assert len(anchors.cell_sizes) == 6
        assert torch.isfinite(anchors.positions).all()
        here = PointCloud(cameras.centers.astype(np.float32), np.ones((1, 3), np.float32), "t")
        assert len(octree(distance_quantile=1.0).seed(here, cameras).positions) >= 1

    def test_a_cloud_that_cannot_be_seeded_is_refused(self) -> None:
        points, nobody = cloud(5), Cameras((), np.zeros((0, 4, 4)), np.zeros((0, 3, 3)), 4, 4)
        with pytest.raises(InputError, match="no training cameras"):
            octree().seed(points, nobody)


class TestBuild:
    def test_default_nodes_are_the_root_cells(self) -> None:
        part = octree()
        anchors = part.seed(cloud(), rig())
        hierarchy = part.build(placed(anchors.positions), anchors)
        hierarchy.validate()
        roots = int((anchors.levels == 0).sum())
        assert hierarchy.num_nodes == roots
        assert torch.equal(hierarchy.parent, torch.arange(roots))
        assert not hierarchy.level.any()
        # every level-0 anchor owns a node, in the order in which they are stored
        assert torch.equal(hierarchy.node_of[anchors.levels == 0], torch.arange(roots))

    @given(
        st.lists(st.tuples(*[st.floats(-50, 50, width=32)] * 3), min_size=1, max_size=25),
        st.integers(0, 3),
        st.randoms(use_true_random=False),
    )
    @settings(max_examples=80, deadline=None)
    def test_partition(self, means: list[tuple[float, float, float]], depth: int, random: object) -> None:
        x, part = torch.tensor(means, dtype=torch.float32), octree(gate_level=depth)
        hierarchy = part.build(placed(x), grid(cell=2.0))
        hierarchy.validate()
        assert hierarchy.node_of.dtype == hierarchy.parent.dtype == torch.int64
        used = set(hierarchy.node_of.tolist()) | set(hierarchy.parent.tolist())
        assert used == set(range(hierarchy.num_nodes))
        assert bool((hierarchy.level[hierarchy.node_of] == depth).all())
        cells = (x.double() / (2.0 / 2**depth)).floor()
        same_cell = (cells[:, None] == cells[None]).all(2)
        assert torch.equal(same_cell, hierarchy.node_of[:, None] == hierarchy.node_of[None])
        up = hierarchy.node_of
        for _ in range(depth):
            up = hierarchy.parent[up]
        roots = (x.double() / 2.0).floor()
        assert torch.equal((roots[:, None] == roots[None]).all(2), up[:, None] == up[None])

    def test_nodes_are_numbered_along_a_morton_curve(self) -> None:
        x = torch.tensor([[3.5, 3.5, 3.5], [0.5, 0.5, 0.5], [1.5, 0.5, 0.5], [0.5, 0.5, 1.5], [2.5, 0.5, 0.5]])
        assert octree().build(placed(x), grid()).node_of.tolist() == [4, 0, 1, 2, 3]

    def test_one_gate_each(self) -> None:
        x = torch.rand(50, 3, generator=torch.Generator().manual_seed(0)) * 4
        alone, cells = octree(grouping="gaussian").build(placed(x), grid()), octree().build(placed(x), grid())
        alone.validate()
        assert sorted(alone.node_of.tolist()) == list(range(50))
        by_cell = cells.node_of[torch.argsort(alone.node_of)]
        assert torch.equal(by_cell, by_cell.sort().values)  # the same spatial order as the cells


def test_with_units_of_the_root_all_levels_travel_alike_and_nothing_else_differs() -> None:
    points, cameras = cloud(), rig()
    own, root = octree().seed(points, cameras), octree(unit="root").seed(points, cameras)
    assert len(own.cell_sizes) > 1
    assert root.cell_sizes.tolist() == [float(own.cell_sizes[0])] * len(own.cell_sizes)
    for name in ("positions", "colors", "levels", "origin"):
        assert torch.equal(getattr(own, name), getattr(root, name)), name
