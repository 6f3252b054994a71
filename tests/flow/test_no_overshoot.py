"""A motion that is predicted and then ends: the error on changed pixels comes back within three frames.

The recordings are analytic and share frame 0. A slow mover goes the same way at constant speed, so that three frames
after a reversal it stands at the same place, in front of the same picture. Compared on training views: with so small a
fit a held-out one mostly shows what frame 0 lacks.
"""

from __future__ import annotations

import math

import pytest

from gsstream.discovery.catalog import load_catalog
from gsstream.engine.assembly.assemble import assemble
from gsstream.engine.frame0.points import gather_points
from gsstream.engine.run.encoder import Encoder
from gsstream.engine.run.measure import HeldOut
from gsstream.engine.run.recording import open_recording
from gsstream.evaluation.records import mean
from gsstream.packet import PlayerState
from gsstream.recipe.load import resolve_recipe

EVENT = 5
WORLD = f"synthetic:views=4&width=64&height=48&supersample=1&frames=20&noise=0.01&event={EVENT}&scene="
#: The rates of frame 0 are those that the bounds below were set with: with others, too, some seeds lose the mover.
SETTINGS = (
    "first_frame.max_iterations=240",
    "first_frame.max_gaussians=3000",
    "first_frame.sh_degree=0",
    "first_frame.points=recording",
    "first_frame.lr_factor=1",
    "stream.epochs=6",
)
#: Loss that is not an overshoot, dB: runs of other seeds differ by half of it.
MARGIN = 1.0


def changed(scene: str, motion: str, first: PlayerState | None, frames: int) -> tuple[PlayerState, list[float]]:
    """Frame 0, and PSNR on changed pixels by frame, mean over the training views."""
    catalog = load_catalog()
    changes = [("test", f"motion={motion}"), *(("test", setting) for setting in SETTINGS)]
    parts = assemble(resolve_recipe("s2gs-edge", catalog.recipe_path, (), changes), catalog)
    uri = f"disturbed:lost_cameras=cam01@{EVENT}-{EVENT + 4}:{WORLD}paths" if scene == "dropout" else WORLD + scene
    source = open_recording(uri, parts.recipe, catalog)
    settings, held, found = parts.recipe.first_frame, HeldOut(parts.renderer), []
    encoder = Encoder(parts, source.info, lambda frame: gather_points(source, frame, settings), first_frame=first)
    for index in range(frames):
        frame = source.frame(index)
        step = encoder.encode(frame)
        first = first or step.state.player
        views = held.measure(step.state.player, encoder.with_near_plane(frame))["psnr_changed"].values()
        found.append(mean(math.nan if view is None else view for view in views))
    assert first is not None
    return first, found


@pytest.fixture(scope="module")
def first() -> PlayerState:
    return changed("stop", "still", None, 1)[0]


def test_after_a_reversal_it_is_as_good_as_a_slow_mover_at_the_same_place(first: PlayerState) -> None:
    back = changed("reversal", "rigid", first, EVENT + 4)[1]
    slow = changed("paths&motion=0.25", "rigid", first, EVENT + 4)[1]
    assert back[EVENT + 3] > slow[EVENT + 3] - MARGIN


def test_after_a_sudden_stop_nothing_goes_on(first: PlayerState) -> None:
    """Nothing changes any more, so the encoder has nothing to look at: what it shows at the stop must be what stays."""
    stop = changed("stop", "rigid", first, EVENT + 4)[1]
    assert min(stop[EVENT + 1 :]) > stop[EVENT] - 0.2
    assert stop[EVENT] > stop[1] - MARGIN


def test_after_a_bounce_it_is_as_good_as_before() -> None:
    bounce = changed("bounce", "rigid", None, EVENT + 5)[1]
    assert max(bounce[EVENT + 2 : EVENT + 4]) > bounce[EVENT - 1] - MARGIN


@pytest.mark.parametrize("event", ["flash", "dropout", "occlusion"])
def test_three_frames_after_a_disturbance_it_is_as_good_as_before(event: str, first: PlayerState) -> None:
    """One overexposed frame, a camera that shows an old picture for some, a body behind another one."""
    disturbed = changed(event, "rigid", None if event == "occlusion" else first, EVENT + 5)[1]
    assert min(disturbed[EVENT + 3 :]) > disturbed[EVENT - 1] - MARGIN
