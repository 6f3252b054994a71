"""Nearest points: against a table of all distances in float64, at the edges, and in memory that follows the cloud."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from gsstream.core.shapes import FloatArray
from gsstream.engine.fit.nearest import nearest_rows, neighbour_distance

KINDS = ("ball", "plane", "line", "grid", "pairs", "aside", "far")


def cloud(kind: str, count: int, seed: int) -> FloatArray:
    rng = np.random.default_rng(seed)
    xyz = rng.normal(size=(count, 3))
    if kind == "plane":
        xyz[:, 2] = 0
    elif kind == "line":
        xyz[:, 1:] = 3
    elif kind == "grid":
        xyz = xyz.round()
    elif kind == "pairs":
        xyz[1::2] = xyz[: count // 2 * 2 : 2]
    elif kind == "aside":
        xyz = xyz * 0.1 + 100  # where a table made by a product of matrices has no distances left
    elif kind == "far":
        xyz = xyz * 100 + 1e7
    return xyz.astype(np.float32)


def table(points: FloatArray, among: FloatArray) -> FloatArray:
    difference = points.astype(np.float64)[:, None] - among.astype(np.float64)[None]
    distances: FloatArray = np.linalg.norm(difference, axis=2)
    return distances


@given(kind=st.sampled_from(KINDS), count=st.integers(2, 60), seed=st.integers(0, 99))
def test_the_spacing_is_that_of_the_three_nearest_others(kind: str, count: int, seed: int) -> None:
    xyz = cloud(kind, count, seed)
    nearest = np.sort(table(xyz, xyz), axis=1)[:, 1:4]
    expected = np.sqrt(np.square(nearest).mean(1))
    found = neighbour_distance(torch.from_numpy(xyz))
    assert found.dtype == torch.float32
    np.testing.assert_allclose(found.numpy(), expected, rtol=1e-6)


@given(kind=st.sampled_from(KINDS), count=st.integers(1, 60), asked=st.integers(0, 20), seed=st.integers(0, 99))
def test_the_nearest_row_is_the_nearest(kind: str, count: int, asked: int, seed: int) -> None:
    means, points = cloud(kind, count, seed), cloud(kind, asked, seed + 1)
    distances, rows = nearest_rows(points, means)
    expected = table(points, means)
    np.testing.assert_allclose(distances, expected.min(1), rtol=1e-6)
    np.testing.assert_array_equal(expected[np.arange(asked), rows], expected.min(1))


@pytest.mark.parametrize("count", [0, 1])
def test_a_point_alone_has_a_size(count: int) -> None:
    found = neighbour_distance(torch.zeros(count, 3))
    assert found.shape == (count,)
    assert (found > 0).all()


def test_nothing_is_infinitely_far_from_everything() -> None:
    distances, rows = nearest_rows(np.zeros((3, 3), np.float32), np.zeros((0, 3), np.float32))
    assert np.isinf(distances).all()
    assert rows.shape == (3,)


def test_memory_follows_the_cloud_and_not_its_square() -> None:
    """A table of all distances, block by block, once left every block on the heap: 12 GB for 60,000 points."""
    code = """
import resource, torch
from gsstream.engine.fit.nearest import neighbour_distance
peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
neighbour_distance(torch.rand(100, 3))
before = peak()
neighbour_distance(torch.rand(60_000, 3))
print(peak() - before)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert float(done.stdout) < 100, "megabytes; the positions themselves are 0.7"
