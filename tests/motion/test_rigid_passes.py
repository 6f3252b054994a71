"""Where the fit of motion looks, and how often: near a change, and in a hurried frame less."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gsstream.engine.step.active.change import Change
from gsstream.motion.rigid import Rigid
from gsstream.testing.working import AtWork, at_work


def near_by_hand(tiles: np.ndarray) -> np.ndarray:
    """Tiles with a changed one at most one row and one column away."""
    out = np.zeros_like(tiles)
    for view, row, column in np.argwhere(tiles):
        out[view, max(0, row - 1) : row + 2, max(0, column - 1) : column + 2] = True
    return out


@pytest.mark.parametrize("share", [0.0, 0.05, 0.3, 1.0])
def test_near_is_what_changed_and_what_lies_beside_it_in_the_same_view(share: float) -> None:
    tiles = np.random.default_rng(3).random((3, 5, 7)) < share
    near = Change(torch.from_numpy(tiles), 80, 112).near
    assert near.dtype == torch.bool
    assert np.array_equal(near.numpy(), near_by_hand(tiles))


def pulled(case: AtWork, tiles: torch.Tensor | None, near_change: bool) -> tuple[float, torch.Tensor]:
    """Loss and slope of all means in view 0 when these tiles changed."""
    work = case.work
    work._change = None if tiles is None else Change(tiles, work.cameras.height, work.cameras.width)
    leaves = work.gaussians.map(lambda value: value.clone().requires_grad_())
    loss = work.pull(0, leaves, near_change)
    return loss, torch.zeros_like(leaves.means) if leaves.means.grad is None else leaves.means.grad


def test_a_pull_near_the_change_leaves_out_all_else() -> None:
    case = at_work()
    assert case.work._change is not None
    tiles = torch.zeros_like(case.work._change.tiles)
    _, slope = pulled(case, tiles, True)
    assert float(slope.abs().max()) == 0, "nothing changed, so nothing is compared"
    everything, every_slope = pulled(case, torch.ones_like(tiles), True)
    without, slope_without = pulled(case, tiles, False)
    assert everything == pytest.approx(without), "where all changed, all is compared"
    torch.testing.assert_close(every_slope, slope_without)
    assert float(every_slope.abs().max()) > 0
    unknown, slope_unknown = pulled(case, None, True)
    assert unknown == pytest.approx(without), "where change is not looked for, all is compared"
    torch.testing.assert_close(slope_unknown, slope_without)


@pytest.mark.parametrize(("effort", "pulls"), [(1.0, 6), (0.5, 3), (0.2, 1), (0.01, 1)])
def test_a_hurried_frame_fits_motion_in_its_share_of_the_passes(effort: float, pulls: int) -> None:
    case = at_work()
    case.work._frame = replace(case.work._frame, effort=effort)
    made, pull = [], case.work.pull
    case.work.pull = lambda *given: made.append(given[0]) or pull(*given)  # type: ignore[method-assign,func-returns-value]
    Rigid(Rigid.Config(epochs=2)).propose(case.scene, case.work, case.rng)
    assert len(made) == pulls, "two passes over three cameras, or a share of them"


def test_motions_look_everywhere_unless_told_to_look_near_the_change() -> None:
    asked: list[bool] = []
    for config in (Rigid.Config(everywhere=False), Rigid.Config()):
        case = at_work()
        pull = case.work.pull

        def noted(view: int, rows: object, near_change: bool = False, pull: object = pull) -> float:
            asked.append(near_change)
            return pull(view, rows, near_change)  # type: ignore[operator]

        case.work.pull = noted  # type: ignore[method-assign,assignment]
        Rigid(config).propose(case.scene, case.work, case.rng)
    half = len(asked) // 2
    assert half > 0
    assert asked == [True] * half + [False] * half
