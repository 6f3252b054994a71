"""The field of key points against a sum over them by hand, and cells that say it."""

from __future__ import annotations

import numpy as np
import torch
from gsstream_comgs.confidence import CORRECTED, LEFT, ErrorGradient
from gsstream_comgs.influence import KeyPoints, field_of, weights_of
from scipy.spatial.transform import Rotation

from gsstream.api import Gaussians, apply_motion
from gsstream.blocks import approximate_by_cells, rotation_matrices, transform_rows
from gsstream.testing import MethodUnderTest
from tests.scenes import scene_at

RNG = np.random.default_rng(0)


def points(number: int) -> KeyPoints:
    def draw(*shape: int, scale: float = 1.0) -> torch.Tensor:
        return torch.from_numpy(RNG.normal(0, scale, shape))

    return KeyPoints(
        draw(number, 3),
        draw(number, 3, scale=0.1),
        draw(number, 3, scale=0.2),
        draw(number, 3, scale=0.3),
        draw(number, 4),
    )


def turned(turn: np.ndarray) -> Rotation:
    """A rotation given as axis * tan(angle / 2)."""
    return Rotation.from_quat([*turn, 1.0])


def test_the_field_is_the_weighted_sum_of_rigid_motions() -> None:
    means, keys = torch.from_numpy(RNG.normal(size=(7, 3))), points(4)
    weights, field = weights_of(means, keys), field_of(means, keys)
    for a, x in enumerate(means.numpy()):
        raw = []
        for k in range(4):
            axes = Rotation.from_quat(np.roll(keys.quat[k].numpy(), -1)).as_matrix()
            spread = axes @ np.diag(np.exp(2 * keys.size[k].numpy())) @ axes.T
            away = x - keys.centre[k].numpy()
            raw.append(np.exp(-0.5 * away @ np.linalg.solve(spread, away)))
        expected = np.array(raw) / max(1.0, sum(raw))
        np.testing.assert_allclose(weights[a], expected, atol=1e-9)
        shift = np.zeros(3)
        for k, w in enumerate(expected):
            centre = keys.centre[k].numpy()
            shift += w * (turned(keys.turn[k].numpy()).apply(x - centre) + centre + keys.shift[k].numpy() - x)
        np.testing.assert_allclose(field.shift[a], shift, atol=1e-9)
        np.testing.assert_allclose(field.turn[a], expected @ keys.turn.numpy(), atol=1e-9)


def test_gaussians_turn_with_the_field() -> None:
    scene = scene_at(RNG.normal(size=(5, 3)), quats=RNG.normal(size=(5, 4))).gaussians.map(torch.from_numpy)
    turn = torch.from_numpy(RNG.normal(0, 0.3, (5, 3)).astype(np.float32))
    after = transform_rows(scene, torch.zeros(5, 3), turn)
    for i in range(5):
        before = Rotation.from_quat(np.roll(scene.quats[i].numpy(), -1)).as_matrix()
        expected = turned(turn[i].numpy()).as_matrix() @ before
        np.testing.assert_allclose(rotation_matrices(after.quats[i : i + 1])[0].numpy(), expected, atol=1e-5)


NO_SHELL = torch.zeros(200, dtype=torch.bool)


def test_cells_say_a_field_that_is_the_same_everywhere_to_half_a_step() -> None:
    scene, rows = scene_at(RNG.uniform(-1, 1, (200, 3))), np.arange(200)
    shift = np.tile([0.33, -0.21, 0.05], (200, 1))
    motion = approximate_by_cells(scene, rows, NO_SHELL, shift, np.zeros((200, 3)), 0.5, 0.02)
    assert motion is not None
    after, touched = apply_motion(scene, motion)
    assert len(touched) == 200
    np.testing.assert_allclose(after.gaussians.means - scene.gaussians.means, shift, atol=0.0101)


def test_cells_of_which_most_may_not_move_stay() -> None:
    scene = scene_at(np.array([[0.1, 0.1, 0.1], [0.2, 0.1, 0.1], [0.3, 0.1, 0.1], [5.1, 0.1, 0.1]]))
    rest = np.zeros((1, 3))
    motion = approximate_by_cells(scene, np.array([0, 3]), NO_SHELL[:4], np.ones((2, 3)), np.zeros((2, 3)), 1.0, 0.1)
    assert motion is not None
    assert apply_motion(scene, motion)[1].tolist() == [3]
    assert approximate_by_cells(scene, np.array([0]), NO_SHELL[:4], rest + 1, rest, 1.0, 0.1) is None
    assert approximate_by_cells(scene, np.array([3]), NO_SHELL[:4], rest, rest, 1.0, 0.1) is None
    last = torch.tensor([False, False, False, True])
    assert approximate_by_cells(scene, np.array([3]), last, rest + 1, rest, 1.0, 0.1) is None, "the shell stays"


class Wrong:
    """A frame in which some Gaussians have a wrong colour, and a screen gradient as large as the error."""

    def __init__(self, gaussians: Gaussians[torch.Tensor], aims: torch.Tensor) -> None:
        self.gaussians, self.aims, self.cameras, self.index = gaussians, aims, [None], 1

    def previous_render(self, view: int) -> torch.Tensor:
        return torch.zeros(1, 1, 3)

    image = previous_render

    def screen_gradient(self, view: int, upstream: torch.Tensor):
        error = (self.gaussians.sh0[:, 0] - self.aims).norm(dim=1)
        return type("Found", (), {"gradient": torch.stack([error, error], 1)})


def test_the_share_with_the_largest_gradient_is_corrected() -> None:
    scene = scene_at(np.zeros((10, 3))).gaussians.map(torch.from_numpy)
    aims = torch.zeros(10, 3)
    aims[[2, 5, 7]] = torch.tensor([[0.4], [0.2], [0.1]])
    for share, rows in ((0.2, [2, 5]), (0.01, [2]), (1.0, [2, 5, 7])):
        logits = ErrorGradient(ErrorGradient.Config(share=share)).estimate(Wrong(scene, aims))
        assert logits.unique().tolist() == [LEFT, CORRECTED]
        assert (logits == CORRECTED).nonzero()[:, 0].tolist() == rows, "those without a gradient are left"


def test_a_residual_is_sent_every_so_many_frames_alone() -> None:
    steps = MethodUnderTest("comgs-l").steps
    assert [step.metrics["iterations"] > 0 for step in steps] == [True, False, True]
    deltas = [step.state.player.delta for step in steps[1:]]
    assert [delta is not None and delta.residual is not None for delta in deltas] == [False, True]
