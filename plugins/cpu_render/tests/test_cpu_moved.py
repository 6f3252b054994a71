"""The gradient by rigid motions of groups in one native call: the bits of the calls that it stands for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from gsstream_cpu_render import _native
from gsstream_cpu_render.renderer import CpuRenderer
from test_cpu_fit import BACKGROUND, comparison, some_tiles
from test_cpu_renderer import rig, scene

from gsstream.api import Comparison, Gaussians, Moves, RenderSession
from gsstream.core.changes.motion import transformed
from gsstream.engine.fit.exposure import Exposure
from gsstream.engine.fit.judge import Judge
from gsstream.loss.photometric import ReferenceLoss
from gsstream.motion.curvature import curvature_of
from gsstream.motion.pull_back import pulled_back

ROWS = torch.tensor([1, 2, 5, 8, 11, 13, 17])


@pytest.fixture(autouse=True)
def is_built() -> None:
    assert hasattr(_native, "pull_moved"), "the kernels are older than the plugin: install it again"


def opened() -> tuple[RenderSession, Gaussians[np.ndarray]]:
    whole = scene()
    return CpuRenderer().open(whole, ROWS, rig(), BACKGROUND), whole.rows(ROWS).map(torch.Tensor.numpy)


def moves(seed: int = 5, groups: int = 3, size: float = 0.3) -> Moves:
    """Groups of which the last one has no row."""
    rng = np.random.default_rng(seed)
    place = np.arange(len(ROWS)) % (groups - 1)
    values = (size * rng.standard_normal((groups, 3)) for _ in range(3))
    return Moves(np.arange(len(ROWS)), place, *values)


def by_single_calls(
    session: RenderSession, rows: Gaussians[np.ndarray], given: Moves, wanted: Comparison
) -> tuple[float, np.ndarray]:
    leaves = transformed(rows, given).map(lambda value: torch.from_numpy(value.copy()).requires_grad_())
    pulled = session.pull(1, leaves.map(torch.Tensor.detach), wanted)
    assert pulled is not None
    for (_, leaf), (_, gradient) in zip(leaves.items(), pulled.gradients.items(), strict=True):
        leaf.grad = gradient
    return pulled.loss, pulled_back(leaves, given)


@pytest.mark.parametrize("size", [0.0, 1e-6, 0.3, 4.0])
@pytest.mark.parametrize("coloured", [False, True])
def test_one_call_has_the_bits_of_single_calls(size: float, coloured: bool, threads: int) -> None:
    wanted, given = comparison(coloured), moves(size=size)
    session, rows = opened()
    found = session.pull_moved(1, rows, given, wanted)
    loss, slope = by_single_calls(*opened(), given, wanted)
    assert found is not None
    assert found[0] == loss
    assert found[1].tobytes() == slope.tobytes()
    assert size > 1 or np.abs(slope[:2]).max() > 0
    assert not slope[2].any(), "a group without rows feels nothing"


@pytest.mark.parametrize("coloured", [False, True])
@pytest.mark.parametrize("some", [False, True])
def test_curvature_is_that_of_the_structure_of_the_picture(coloured: bool, some: bool, threads: int) -> None:
    """Of the picture as its camera records it, in the tiles that count; the slope has the same bits as without."""
    wanted, given = comparison(coloured), moves()
    tiles = some_tiles() if some else None
    wanted = replace(wanted, tiles=tiles)
    session, rows = opened()
    found = session.pull_moved(1, rows, given, wanted, curved=True)
    assert found is not None
    assert found.curvature is not None
    assert found.slope.tobytes() == by_single_calls(*opened(), given, wanted)[1].tobytes()
    exposure = None
    if coloured:
        assert wanted.matrix is not None
        assert wanted.offset is not None
        exposure = Exposure(wanted.matrix.expand(2, 3, 3), wanted.offset.expand(2, 3))
    judge = Judge(ReferenceLoss(), 0.2, np.stack([wanted.target.image] * 2), exposure)
    there = transformed(rows, given).map(torch.from_numpy)
    structure = judge.structure(opened()[0], 1, there, tiles)
    expected = curvature_of(there.means.numpy(), given, rig(), 1, structure)
    np.testing.assert_allclose(found.curvature, expected, atol=1e-4 * np.abs(expected).max())
    assert np.abs(expected[:2]).max() > 0
    assert not found.curvature[2].any(), "a group without rows is held by nothing"


def test_tiles_that_are_left_out_say_nothing() -> None:
    wanted, given = replace(comparison(), tiles=some_tiles()), moves()
    session, rows = opened()
    found = session.pull_moved(1, rows, given, wanted)
    assert found is not None
    assert found[1].tobytes() == by_single_calls(*opened(), given, wanted)[1].tobytes()


def test_a_fault_and_another_loss_are_left_to_single_calls() -> None:
    session, rows = opened()
    far = moves()._replace(shift=np.full((3, 3), 1e39))
    assert session.pull_moved(1, rows, far, comparison()) is None
    wanted = comparison()
    assert session.pull_moved(1, rows, moves(), Comparison(ReferenceLoss(), wanted.target, 0.2)) is None
    assert CpuRenderer().open(scene(), None, rig(), BACKGROUND).pull_moved(1, rows, moves(), wanted) is None


def test_a_render_after_it_is_that_of_the_scene() -> None:
    session, rows = opened()
    session.pull_moved(1, rows, moves(), comparison())
    fresh, _ = opened()
    there = rows.map(torch.from_numpy)
    assert torch.equal(session.render(1, there).image, fresh.render(1, there).image)
