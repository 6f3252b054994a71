"""Where the fit of motion looks, and how often: near a change, and in a hurried frame less."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import numpy as np
import pytest
import torch

from gsstream.engine.step.active.change import Change
from gsstream.parts.motion.rigid import Rigid
from gsstream.parts.render.wrt import WrtRows
from gsstream.testing.working import FitFixture, fit_fixture


def near_by_hand(tiles: np.ndarray) -> np.ndarray:
    """Tiles with a changed one at most one row and one column away."""
    out = np.zeros_like(tiles)
    for view, row, column in np.argwhere(tiles):
        out[view, max(0, row - 1) : row + 2, max(0, column - 1) : column + 2] = True
    return out


@pytest.mark.parametrize("share", [0.0, 0.05, 0.3, 1.0])
def test_near_is_what_changed_and_what_lies_beside_it_in_the_same_view(share: float) -> None:
    tiles = np.random.default_rng(3).random((3, 5, 7)) < share
    near = Change(torch.from_numpy(tiles), 80, 112).dilated
    assert near.dtype == torch.bool
    assert np.array_equal(near.numpy(), near_by_hand(tiles))


def differentiated(
    case: FitFixture, tiles: torch.Tensor | None, looked_at: Literal["all", "changed"]
) -> tuple[float, torch.Tensor]:
    """Loss of view 0 and its gradient by all means when these tiles changed."""
    work = case.work
    work._change = None if tiles is None else Change(tiles, work.cameras.height, work.cameras.width)
    found = work.loss_and_grad(0, WrtRows(work.gaussians), looked_at)
    return float(found.loss), found.grad.means


def test_changed_tiles_alone_leave_out_all_else() -> None:
    case = fit_fixture()
    assert case.work._change is not None
    tiles = torch.zeros_like(case.work._change.tiles)
    _, gradient = differentiated(case, tiles, "changed")
    assert float(gradient.abs().max()) == 0, "nothing changed, so nothing is compared"
    everything, every_gradient = differentiated(case, torch.ones_like(tiles), "changed")
    without, gradient_without = differentiated(case, tiles, "all")
    assert everything == pytest.approx(without), "where all changed, all is compared"
    torch.testing.assert_close(every_gradient, gradient_without)
    assert float(every_gradient.abs().max()) > 0
    unknown, gradient_unknown = differentiated(case, None, "changed")
    assert unknown == pytest.approx(without), "where change is not looked for, all is compared"
    torch.testing.assert_close(gradient_unknown, gradient_without)


def noted(case: FitFixture) -> list[str]:
    """The tiles that each call is to look at, noted as the calls are made."""
    asked: list[str] = []
    body = case.work.loss_and_grad

    def call(view: int, wrt: Any, tiles: str = "all") -> Any:
        asked.append(tiles)
        return body(view, wrt, tiles)  # type: ignore[arg-type]

    case.work.loss_and_grad = call  # type: ignore[method-assign,assignment]
    return asked


@pytest.mark.parametrize(("effort", "calls"), [(1.0, 6), (0.5, 3), (0.2, 1), (0.01, 1)])
def test_a_hurried_frame_fits_motion_in_its_share_of_the_passes(effort: float, calls: int) -> None:
    case = fit_fixture()
    case.work._frame = replace(case.work._frame, epoch_scale=effort)
    made = noted(case)
    Rigid(Rigid.Config(epochs=2)).propose(case.scene, case.work, case.rng)
    assert len(made) == calls, "two passes over three cameras, or a share of them"


@pytest.mark.parametrize(
    ("everywhere", "large", "tiles"),
    [(False, 960, "changed"), (True, 1, "all"), ("auto", 960, "all"), ("auto", 1, "changed")],
)
def test_motions_look_everywhere_unless_told_to_look_near_the_change(
    everywhere: Any, large: int, tiles: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``large`` is the width from which pictures count as large; those of the case are small."""
    case = fit_fixture()
    asked = noted(case)
    monkeypatch.setattr("gsstream.core.picture_size.LARGE", large)
    Rigid(Rigid.Config(everywhere=everywhere)).propose(case.scene, case.work, case.rng)
    assert set(asked) == {tiles}
