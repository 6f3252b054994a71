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
from gsstream.engine.fit.photometric import FrameImages
from gsstream.engine.state.colour_maps import exposure_with
from gsstream.engine.state.drift import cameras_apart, changes, looked_at
from gsstream.engine.state.stream_state import StreamState
from gsstream.engine.step.context import EngineContext
from gsstream.engine.step.gains import new_gains
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


def context(images: np.ndarray, gains: np.ndarray | None = None) -> EngineContext:
    """A frame with these pictures, before which the cloud was shown as it is."""
    work = fit_fixture().work
    player = PlayerState(0, replace(fit_fixture().scene, gaussians=cloud().map(torch.Tensor.numpy)), None)  # type: ignore[arg-type]
    frame = replace(work._frame, images=images, cameras=rig(VIEWS))
    return EngineContext(
        work._assembly,
        StreamState(player, work.hierarchy, frame, exposure=exposure_with(None, gains)),
        frame,
        FrameLog(),
    )


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


def gains_after(images: np.ndarray, before: np.ndarray | None = None, known: np.ndarray | None = None) -> np.ndarray:
    """[8, 3] gains after these pictures; ``before``: those they are compared with, of which ``known`` has been told."""
    work = context(images)
    lit = looked_at(0, FrameImages(pictures(cloud()) if before is None else before, torch.device("cpu")), None)
    now = looked_at(5, FrameImages(images, torch.device("cpu")), known)
    apart = cameras_apart(changes(lit, now), levels=1)
    found = new_gains(work._assembly, work.gaussians, rig(VIEWS), before=lit, now=now, apart=apart)
    return np.ones((VIEWS, 3), np.float32) if found is None else found


def gained(shown: Gaussians[torch.Tensor], gains: dict[int, object]) -> np.ndarray:
    """Pictures of a scene, of which some cameras' are brighter by a factor, or by one for each channel."""
    images = pictures(shown)
    for view, gain in gains.items():
        images[view] *= np.asarray(gain, np.float32)
    return images


@pytest.mark.parametrize(
    "drifting",
    [{2: 0.95}, {2: 0.7}, {2: 1.2, 5: 0.9}, {0: 0.9, 3: 0.9, 6: 0.9}, {4: (1.06, 1.0, 0.95)}],
    ids=["darker", "a jump", "two that differ", "three alike", "white balance"],
)
@pytest.mark.parametrize("light", ["stays", "dims", "is shaded"])
def test_cameras_that_drift_have_their_gains_whatever_the_light_does(drifting: dict[int, object], light: str) -> None:
    """Fewer than half of eight; those that do not drift have the gain 1, to the digit."""
    room = under({"stays": ONE, "dims": 0.97 * ONE, "is shaded": 1 - 0.06 * SHADED}[light])
    wanted = np.ones((VIEWS, 3))
    for view, gain in drifting.items():
        wanted[view] = gain
    found = gains_after(gained(room, drifting))
    np.testing.assert_allclose(found, wanted, atol=0.01)
    others = [view for view in range(VIEWS) if view not in drifting]
    assert (found[others] == 1).all()


@pytest.mark.parametrize("light", [0.97 * ONE, 1 - 0.06 * SHADED, 1 - 0.2 * SHADED, 1.3 * ONE])
def test_no_camera_gets_a_gain_for_light(light: torch.Tensor) -> None:
    assert (gains_after(pictures(under(light))) == 1).all()


def test_a_gain_goes_on_from_what_is_known() -> None:
    """A camera that has lost a tenth loses a twentieth of the rest."""
    known = np.ones((VIEWS, 3), np.float32)
    known[2] = 0.9
    found = gains_after(gained(cloud(), {2: 0.855}), known=known)
    np.testing.assert_allclose(found[2], 0.855, atol=2e-3)
    assert (np.delete(found, 2, 0) == 1).all()


@pytest.mark.parametrize(("known", "gain"), [(0.2, 0.1), (5.0, 10.0), (0.125, 0.06)])
def test_a_camera_that_fades_away_keeps_the_gain_it_had(known: float, gain: float) -> None:
    """Beyond an eighth and eight times nothing is left of a picture but noise."""
    gains = np.ones((VIEWS, 3), np.float32)
    gains[2] = known
    assert np.array_equal(gains_after(gained(cloud(), {2: gain}), known=gains), gains)


def test_a_frame_is_fitted_in_the_colours_that_a_camera_has_now() -> None:
    """The scene as it is explains the picture of a camera that has lost a tenth; without the gain it does not."""
    images = gained(cloud(), {2: 0.9})
    gains = np.ones((VIEWS, 3), np.float32)
    gains[2] = 0.9
    errors = []
    for known in (None, gains):
        work = context(images, known)
        errors.append(float((work.shown(work.gaussians, 2) - work.image(2)).abs().max()))
    assert errors[0] > 0.02
    assert errors[1] < 1e-5


def test_a_flash_asks_for_nothing() -> None:
    """What is off by more than the light could be shows something else."""
    found = wanted(pictures(cloud()) + np.float32(0.2))
    assert not found.change.any()
