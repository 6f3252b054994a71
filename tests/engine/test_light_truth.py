"""What is asked of the colours of a known scene under light that dims, jumps or is shaded, and by cameras that drift.

The pictures are renders of a cloud whose colours are known, so that all of the truth is: colours, light and cameras.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from gsstream.core.gaussians import SH0, Gaussians
from gsstream.core.log import FrameLog
from gsstream.engine.state.stream_state import StreamState
from gsstream.engine.step.context import EngineContext
from gsstream.engine.step.light import Wanted, wanted_colours
from gsstream.packet import PlayerState
from gsstream.testing.cases import rig, scene
from gsstream.testing.method_driver import fit_fixture

VIEWS, LEVEL = 8, 1 / 255


def cloud() -> Gaussians[torch.Tensor]:
    """150 Gaussians that overlap, with colours between 0.2 and 0.8."""
    draws = torch.Generator().manual_seed(0)
    found = scene(0.4 * torch.randn(150, 3, generator=draws), scales=torch.full((150, 3), -1.8))
    return replace(found, sh0=(0.6 * torch.rand(150, 1, 3, generator=draws) - 0.3) / SH0)


def under(light: torch.Tensor) -> Gaussians[torch.Tensor]:
    """The cloud with the colours of each Gaussian times a factor [150]."""
    found = cloud()
    return replace(found, sh0=((found.sh0 * SH0 + 0.5) * light[:, None, None] - 0.5) / SH0)


def context(images: np.ndarray) -> EngineContext:
    """A frame with these pictures, before which the cloud was shown as it is."""
    work = fit_fixture().work
    player = PlayerState(0, replace(fit_fixture().scene, gaussians=cloud().map(torch.Tensor.numpy)), None)  # type: ignore[arg-type]
    frame = replace(work._frame, images=images, cameras=rig(VIEWS))
    return EngineContext(work._assembly, StreamState(player, work.hierarchy, frame), frame, FrameLog())


def pictures(shown: Gaussians[torch.Tensor], drift: np.ndarray | float = 0.0) -> np.ndarray:
    """[8, H, W, 3] renders of a scene, to which each camera adds its own drift."""
    blank: np.ndarray = np.zeros((VIEWS, rig().height, rig().width, 3), np.float32)
    views = np.stack([context(blank).shown(shown, view).numpy() for view in range(VIEWS)])
    return (views + np.broadcast_to(drift, VIEWS)[:, None, None, None]).astype(np.float32)


def wanted(images: np.ndarray) -> Wanted:
    work = context(images)
    return wanted_colours(work._assembly, work.gaussians, work)


def error(found: Wanted, truth: np.ndarray) -> tuple[float, float]:
    """How far pictures of the cloud are from the truth before and after its colours change: mean over pixels."""
    after = replace(cloud(), sh0=cloud().sh0 + torch.from_numpy(found.change[:, None]).float())
    before, now = (float((pictures(shown) - truth).mean()) for shown in (cloud(), after))
    return before, now


ONE = torch.ones(150)
SHADED = (cloud().means[:, 1] > 0).float()


@pytest.mark.parametrize("drift", [0.0, -4.0])
def test_light_that_dims_is_met_but_for_a_quarter_whatever_one_camera_does(drift: float) -> None:
    """The room loses three hundredths; camera 2 drifts by four levels, which stay with that camera."""
    dimmed = under(0.97 * ONE)
    cameras = np.zeros(VIEWS)
    cameras[2] = drift * LEVEL
    found = wanted(pictures(dimmed, cameras))
    before, after = error(found, pictures(dimmed))
    assert before > 2 * LEVEL
    assert abs(after) < 0.25 * before
    np.testing.assert_allclose(found.cameras.mean(1), cameras, atol=0.1 * LEVEL)


def test_a_cloud_over_one_side_darkens_that_side() -> None:
    shaded = under(1 - 0.06 * SHADED)
    found = wanted(pictures(shaded))
    before, after = error(found, pictures(shaded))
    assert abs(after) < 0.25 * before
    asked = np.abs(found.change).max(1) > 0
    dark, light = (found.change[asked & (SHADED.numpy() == side)].mean() * SH0 / LEVEL for side in (1, 0))
    assert dark < -4
    assert abs(light) < 1


@pytest.mark.parametrize("drifting", [{2: -4.0}, {2: -4.0, 5: 6.0}, {0: 8.0, 3: 8.0, 6: 8.0}])
def test_cameras_that_drift_alone_change_no_colour_and_are_told(drifting: dict[int, float]) -> None:
    """Fewer than half of eight cameras: exposure up or down, of one, of two that differ, of three alike."""
    cameras = np.zeros(VIEWS)
    for view, levels in drifting.items():
        cameras[view] = levels * LEVEL
    found = wanted(pictures(cloud(), cameras))
    np.testing.assert_allclose(found.change * SH0, 0, atol=0.05 * LEVEL)
    np.testing.assert_allclose(found.cameras, np.repeat(cameras[:, None], 3, 1), atol=0.05 * LEVEL)


def test_white_balance_that_drifts_is_told_by_channel() -> None:
    shift = np.array([3.0, 0.0, -3.0]) * LEVEL
    images = pictures(cloud())
    images[4] += shift.astype(np.float32)
    found = wanted(images)
    np.testing.assert_allclose(found.change * SH0, 0, atol=0.05 * LEVEL)
    np.testing.assert_allclose(found.cameras[4], shift, atol=0.05 * LEVEL)


def test_a_flash_asks_for_nothing() -> None:
    """What is off by more than the light could be shows something else."""
    found = wanted(pictures(cloud()) + np.float32(0.2))
    assert not found.change.any()
