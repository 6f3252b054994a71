"""Gauss-Newton steps on groups: exact where the loss is quadratic, held back where the images say nothing."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
import torch

from gsstream.core.changes.motion import GroupTransforms, predict_transforms, transform_groups
from gsstream.core.gaussians import Gaussians
from gsstream.core.log import FrameLog
from gsstream.engine.state.stream_state import StreamState
from gsstream.engine.step.context import EngineContext
from gsstream.packet import PlayerState
from gsstream.parts.motion.fitting import narrow_to
from gsstream.parts.motion.groups import changed_groups, known_groups, pixel_size
from gsstream.parts.motion.newton import (
    BodySettings,
    DampedNewton,
    Damping,
    fit_transforms_newton,
    share_of_prediction,
)
from gsstream.parts.render.transforms import Pinhole, curvature_of
from gsstream.parts.render.wrt import LossAndGrad, WrtTransforms
from gsstream.testing.cases import get_case
from gsstream.testing.method_driver import FitFixture, fit_fixture

FREE = Damping(0.0, 1e-9, 1e9)


def start(groups: int) -> torch.Tensor:
    return torch.zeros(groups, 6, dtype=torch.float64)


def bowls(views: int, groups: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Matrices [V, K, 6, 6] and bottoms [V, K, 6] of losses (x - bottom)^T matrix (x - bottom) / 2."""
    rng = np.random.default_rng(seed)
    roots = rng.standard_normal((views, groups, 6, 8))
    matrices, bottoms = roots @ np.swapaxes(roots, -1, -2), rng.standard_normal((views, groups, 6))
    return torch.from_numpy(matrices), torch.from_numpy(bottoms)


@pytest.mark.parametrize("views", [1, 2, 7])
def test_after_each_view_of_the_first_pass_it_stands_at_the_bottom_of_all_seen_so_far(views: int) -> None:
    matrices, bottoms = bowls(views, 5, 2)
    descent = DampedNewton(start(5), FREE)
    for view in range(views):
        gradient = (matrices[view] @ (descent.values - bottoms[view])[..., None])[..., 0]
        descent.step(gradient, matrices[view])
        total, weighted = (each[: view + 1].sum(0).numpy() for each in (matrices, matrices @ bottoms[..., None]))
        np.testing.assert_allclose(descent.values, np.linalg.solve(total, weighted)[..., 0], atol=1e-6)


def test_a_view_that_is_not_measured_is_taken_to_curve_as_the_others_do() -> None:
    matrices, bottoms = bowls(3, 4, 3)
    same = matrices.mean(0).expand_as(matrices)
    measured, taken = DampedNewton(start(4), FREE), DampedNewton(start(4), FREE)
    for step in range(7):
        view = step % 3
        for descent, curvature in ((measured, same[0]), (taken, same[0] if step < 3 else None)):
            descent.step((same[view] @ (descent.values - bottoms[view])[..., None])[..., 0], curvature)
    np.testing.assert_allclose(taken.values, measured.values, rtol=1e-12)


def test_a_group_that_no_picture_holds_moves_by_no_more_than_its_gradient_over_the_absolute_damping() -> None:
    gradient = torch.from_numpy(np.random.default_rng(4).standard_normal((3, 6)))
    descent = DampedNewton(start(3), Damping(0.1, 50.0, 0.5))
    descent.step(gradient, start(3)[..., None].expand(3, 6, 6))
    np.testing.assert_allclose(descent.values, -gradient / 50)


def test_no_number_moves_further_than_the_longest_step_and_its_direction_stays() -> None:
    gradient = 1e9 * torch.tensor([[1.0, -2.0, 0.5, 0.0, 0.0, 0.0], [1e-12] * 6], dtype=torch.float64)
    descent = DampedNewton(start(2), Damping(0.1, 40.0, 0.5))
    descent.step(gradient, torch.eye(6, dtype=torch.float64).expand(2, 6, 6))
    np.testing.assert_allclose(descent.values[0], [-0.25, 0.5, -0.125, 0, 0, 0])
    assert float(descent.values[1].abs().max()) < 1e-3, "one group's length is not another's"


def places(means: np.ndarray, case: object, view: int) -> np.ndarray:
    cameras = case.cameras  # type: ignore[attr-defined]
    seen = means @ cameras.viewmats[view, :3, :3].T + cameras.viewmats[view, :3, 3]
    return np.asarray(seen[:, :2] / seen[:, 2:] * np.diag(cameras.Ks[view])[:2] + cameras.Ks[view][:2, 2])


@pytest.mark.parametrize("number", range(6))
def test_curvature_is_how_far_rows_go_on_the_screen_times_what_holds_them_there(number: int) -> None:
    """d^T C d of a group is the sum over its rows of (shift on the screen)^T S (shift on the screen)."""
    case, rng = get_case("cloud"), np.random.default_rng(5)
    rows = np.arange(0, len(case.gaussians), 7)
    base = case.gaussians.map(lambda value: value.double().numpy()).rows(rows)
    place = np.arange(len(rows)) % 2
    centre = np.stack([base.means[place == k].mean(0) for k in range(2)])
    moves = GroupTransforms(np.arange(len(rows)), place, centre, 0.05 * rng.standard_normal((2, 3)), np.zeros((2, 3)))
    roots = rng.standard_normal((len(rows), 2, 2))
    tensors = roots @ np.swapaxes(roots, 1, 2)
    structure = np.stack([tensors[:, 0, 0], tensors[:, 0, 1], tensors[:, 1, 1]], 1)

    def moved(size: float) -> np.ndarray:
        along = np.zeros((2, 6))
        along[:, number] = size
        return transformed64(base, moves._replace(translation=moves.translation + along[:, :3], rotation=along[:, 3:]))

    now = moved(0.0)
    given = (
        torch.from_numpy(now),
        moves.map(torch.from_numpy),
        case.cameras,
        Pinhole.of(case.cameras, 1),
        torch.from_numpy(structure),
    )
    curvature = curvature_of(*given).numpy()
    step = (places(moved(1e-5), case, 1) - places(moved(-1e-5), case, 1)) / 2e-5
    held = np.einsum("ai,aij,aj->a", step, tensors, step)
    values = 3 * case.cameras.height * case.cameras.width
    expected = [held[place == k].sum() / values for k in range(2)]
    np.testing.assert_allclose(curvature[:, number, number], expected, rtol=1e-6)
    np.testing.assert_allclose(curvature, np.swapaxes(curvature, 1, 2))
    assert np.linalg.eigvalsh(curvature).min() > -1e-9 * np.abs(curvature).max()


def transformed64(base: Gaussians[np.ndarray], moves: GroupTransforms) -> np.ndarray:
    """Means after rigid motions, in double precision: x' = R (x - centre) + centre + shift."""
    x, y, z = moves.rotation.T
    zero = np.zeros_like(x)
    cross = np.stack([np.stack([zero, -z, y], -1), np.stack([z, zero, -x], -1), np.stack([-y, x, zero], -1)], -2)
    turned = np.linalg.solve(np.eye(3) - cross, np.eye(3) + cross)  # Cayley's transform of tan(angle / 2)
    arm = base.means - moves.center[moves.group]
    return np.asarray((turned[moves.group] @ arm[..., None])[..., 0] + (moves.center + moves.translation)[moves.group])


def test_the_transform_by_hand_is_that_of_the_stream() -> None:
    case, rng = get_case("cloud"), np.random.default_rng(6)
    base = case.gaussians.map(torch.Tensor.numpy)
    place = np.zeros(len(base.means), np.int64)
    moves = GroupTransforms(np.arange(len(place)), place, *(0.3 * rng.standard_normal((1, 3)) for _ in range(3)))
    np.testing.assert_allclose(transform_groups(base, moves).means, transformed64(base, moves), atol=1e-5)


def moving(case: FitFixture) -> tuple[Gaussians[torch.Tensor], GroupTransforms[torch.Tensor]]:
    """All groups that lie in what changed, where they stand, and the work narrowed to them."""
    groups = known_groups(case.scene, case.work.cameras, 12, 2)
    able = changed_groups(groups, case.work, 0.75, 0.5)
    start = predict_transforms(case.scene, groups, able.astype(np.uint8), predicted=True)
    return narrow_to(case.work, start)


@pytest.mark.parametrize("tiles", ["all", "changed"])
def test_gradients_are_the_same_with_and_without_curvature(tiles: Literal["all", "changed"]) -> None:
    case = fit_fixture()
    base, moves = moving(case)
    found, without = (case.work.loss_and_grad(1, WrtTransforms(base, moves, curved), tiles) for curved in (True, False))
    torch.testing.assert_close(found.grad, without.grad, rtol=1e-5, atol=1e-9)
    assert without.curvature is None
    assert found.curvature is not None
    assert found.curvature.shape == (len(moves.center), 6, 6)
    assert float(found.curvature.abs().max()) > 0


def test_nothing_that_changed_holds_nothing() -> None:
    case = fit_fixture(changed=False)
    rows = np.arange(0, len(case.scene.gaussians.means), 3)
    case.work.narrow(torch.from_numpy(rows))
    zeros = np.zeros((1, 3))
    moves = GroupTransforms(np.arange(len(rows)), np.zeros(len(rows), np.int64), zeros, zeros, zeros).map(
        torch.from_numpy
    )
    base = case.scene.gaussians.rows(rows).map(torch.from_numpy)
    found = case.work.loss_and_grad(0, WrtTransforms(base, moves, curvature=True), "changed")
    assert not found.grad.any()
    assert found.curvature is not None
    assert not found.curvature.any()


@pytest.mark.parametrize("went", [1.0, 0.6, 0.3, 0.0, -0.3, -0.7, -1.0])
def test_a_fit_begins_at_the_share_of_a_prediction_that_the_pictures_are_nearest_to(went: float) -> None:
    """Losses of two views that disagree about the place are weighed together."""
    predicted = torch.tensor([[3.0, -1.0, 0.5, 0, 0, 0], [0.0, 2.0, 0.0, 1.0, 0, 0]])
    asked: list[int] = []

    def compared(values: torch.Tensor, view: int) -> LossAndGrad[torch.Tensor]:
        asked.append(view)
        return LossAndGrad((values - went * predicted + 0.2 * (1 - view)).square().sum(), values)

    nearest = min((1.0, 0.0, -1.0), key=lambda share: abs(share - went))
    assert share_of_prediction(predicted, compared, (0, 2)) == nearest
    assert set(asked) == {0, 2}
    assert len(asked) <= 6


@pytest.mark.parametrize("ahead", [-2.0, 0.0, 0.9, 4.0])
@pytest.mark.parametrize("settings", [BodySettings(0.0, 500.0), BodySettings(200.0, 500.0)])
@pytest.mark.parametrize("seed", [1, 2])
def test_a_body_that_moved_is_found_where_it_went(seed: int, settings: BodySettings, ahead: float) -> None:
    """The pictures are renders of a cloud of which one half moved by a pixel or two and turned by a degree or two.

    It was expected ``ahead`` times as far: it went on, stood before, stops or turned back.
    """
    cloud, work, rng = get_case("cloud"), fit_fixture().work, np.random.default_rng(seed)
    cameras, gaussians = cloud.cameras, cloud.gaussians.map(torch.Tensor.numpy)
    rows = np.flatnonzero(gaussians.means[:, 0] < np.median(gaussians.means[:, 0]))
    pixel = pixel_size(gaussians.means, cameras)
    centre = gaussians.means[rows].mean(0, keepdims=True, dtype=np.float64)
    shift, turn = pixel * rng.uniform(-2, 2, (1, 3)), rng.uniform(-0.02, 0.02, (1, 3))
    moves = GroupTransforms(rows, np.zeros(len(rows), np.int64), centre, shift, turn)
    after = transform_groups(gaussians, moves).map(torch.from_numpy)
    blank: np.ndarray = np.zeros((len(cameras), cameras.height, cameras.width, 3), np.float32)
    frame = replace(work._frame, images=blank, cameras=cameras)

    def seen(images: np.ndarray) -> EngineContext:
        player = PlayerState(0, replace(fit_fixture().scene, gaussians=gaussians), None)  # type: ignore[arg-type]
        state = StreamState(player, work.hierarchy, frame)
        return EngineContext(work._assembly, state, replace(frame, images=images), FrameLog())

    images = np.stack([seen(blank).shown(after, view).numpy() for view in range(len(cameras))])
    arm = float(np.linalg.norm(gaussians.means[rows] - centre, axis=1).mean())
    unit, order = np.array([pixel] * 3 + [pixel / arm] * 3), np.random.default_rng(0)
    start = moves._replace(translation=ahead * shift, rotation=ahead * turn)
    found = fit_transforms_newton(seen(images), start, unit, 8 * len(cameras), order, Damping(0.1, 1.0, 0.5), settings)
    wanted = np.concatenate([shift, turn], 1)
    before, now = np.abs(wanted / unit).max(), np.abs((found - wanted) / unit).max()
    assert now < 0.15, f"{now:.2f} of {before:.2f} pixels are left"
