"""Where the optical axes of a rig meet: one answer for seeds, checks and the player."""

from __future__ import annotations

import numpy as np
import pytest

from gsstream.core.cameras import Cameras
from gsstream.core.focus import focus_point, meeting_point
from tests.rigs import looking

K = [[60.0, 0, 32], [0, 60.0, 24], [0, 0, 1]]


def rig(centers: object, targets: object) -> Cameras:
    return looking(centers, targets, K=K, size=(64, 48))


def arc(number: int, degrees: float) -> np.ndarray:
    angles = np.radians(np.linspace(-degrees / 2, degrees / 2, number))
    return np.stack([4 * np.cos(angles), 4 * np.sin(angles), np.zeros(number)], 1)


LINE = np.stack([np.full(5, 2.0), np.linspace(-1, 1, 5), np.full(5, 0.5)], 1)
FACING = np.array([[3.0, 0, 1], [-3, 0, 1]])
#: name: rig, where its axes meet (None: they do not say), what it looks at. The points are drawn weakly to the cameras,
#: by a tenth of the distance where axes are 4 degrees apart.
RIGS = {
    "an arc": (rig(arc(7, 90), (0, 0, 0)), (0, 0, 0), (0, 0, 0)),
    "a narrow arc": (rig(arc(5, 8), (0, 0, 0)), (0, 0, 0), (0, 0, 0)),
    "a ring": (rig(arc(8, 315), (0.1, 0, 0.2)), (0.1, 0, 0.2), (0.1, 0, 0.2)),
    "an arc that looks away": (rig(arc(7, 50), 2 * arc(7, 50)), (0, 0, 0), (0, 0, 0)),
    "parallel": (rig(LINE, LINE - (1, 0, 0)), None, (2 - 1.1, 0, 0.5)),
    "parallel as far as a calibration says": (rig(LINE, LINE * (1, 0.995, 1) - (1, 0, 0)), None, (0.9, 0, 0.5)),
    "one camera": (rig([[2.0, 0, 0]], (0, 0, 0)), None, (1, 0, 0)),
    "face to face": (rig(FACING, (0, 0, 1)), (0, 0, 1), (0, 0, 1)),
    "back to back": (rig(FACING, FACING * (2, 1, 1)), (0, 0, 1), (0, 0, 1)),
}


@pytest.mark.parametrize("name", RIGS)
def test_the_point_is_known_where_axes_meet_and_before_the_rig_elsewhere(name: str) -> None:
    cameras, meeting, focus = RIGS[name]
    found = meeting_point(cameras)
    assert (found is None) == (meeting is None)
    distance = np.linalg.norm(cameras.centers - focus, axis=1).mean()
    assert np.linalg.norm(focus_point(cameras) - focus) < (0.1 if name == "a narrow arc" else 0.01) * distance
    if found is not None:
        axes = cameras.viewmats[:, 2, :3]
        # Distances to all axes, and weakly to the middle, as the rows of one least-squares problem.
        across = np.eye(3) - np.einsum("ci,cj->cij", axes, axes)
        rows = np.concatenate([*across, np.sqrt(1e-4 * len(axes)) * np.eye(3)])
        wanted = [*np.einsum("cij,cj->ci", across, cameras.centers).ravel()]
        middle = cameras.centers.mean(0)
        best = np.linalg.lstsq(rows, np.concatenate([wanted, np.sqrt(1e-4 * len(axes)) * middle]), rcond=None)[0]
        np.testing.assert_allclose(found, best, atol=1e-9)


@pytest.mark.parametrize(
    "name", [name for name in RIGS if name != "one camera"]
)  # of which the extent is 1 in any unit
def test_a_rig_that_is_moved_and_scaled_takes_the_point_along(name: str) -> None:
    cameras = RIGS[name][0]
    rng = np.random.default_rng(5)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    offset, scale = rng.normal(size=3), 37.0
    viewmats = cameras.viewmats.copy()
    viewmats[:, :3, :3] = cameras.viewmats[:, :3, :3] @ rotation.T
    centers = scale * cameras.centers @ rotation.T + offset
    viewmats[:, :3, 3] = -np.einsum("cij,cj->ci", viewmats[:, :3, :3], centers)
    moved = Cameras(cameras.ids, viewmats, cameras.Ks, cameras.width, cameras.height)
    np.testing.assert_allclose(focus_point(moved), scale * rotation @ focus_point(cameras) + offset, atol=1e-6)
