"""The events of the synthetic scene happen at the frame that is asked for, exactly, and nothing else does."""

from __future__ import annotations

import numpy as np
import pytest

from gsstream.core.errors import SourceError
from gsstream.input.recordings.open import open_source
from gsstream.input.recordings.synthetic import SyntheticSource

EVENT = 5


def scene(name: str, **more: object) -> SyntheticSource:
    options = {"scene": name, "event": EVENT, "frames": 20, "width": 48, "height": 36, "views": 3, "supersample": 1}
    source = open_source("synthetic:" + "&".join(f"{key}={value}" for key, value in {**options, **more}.items()))
    assert isinstance(source, SyntheticSource)
    return source


def track(source: SyntheticSource, name: str = "ball") -> np.ndarray:
    return np.stack([source.object_positions(t)[name] for t in range(20)])


def test_what_stops_stands_still_from_the_event_on_and_goes_the_usual_way_before() -> None:
    stop, paths = scene("stop"), scene("paths")
    np.testing.assert_array_equal(track(stop)[: EVENT + 1], track(paths)[: EVENT + 1])
    assert (track(stop)[EVENT:] == track(stop)[EVENT]).all()
    assert stop.frame(EVENT).images.tobytes() == stop.frame(19).images.tobytes()
    assert stop.frame(EVENT - 1).images.tobytes() != stop.frame(EVENT).images.tobytes()


def test_the_first_event_is_that_of_frame_1() -> None:
    stop = scene("stop", event=1)
    assert (track(stop)[1:] == track(stop)[1]).all()
    assert (track(stop)[0] != track(stop)[1]).any()
    with pytest.raises(SourceError, match=r"event.*greater than or equal to 1"):
        scene("stop", event=0)


def test_what_turns_back_shows_its_pictures_in_the_reverse_order() -> None:
    source = scene("reversal")
    for step in range(1, EVENT + 1):
        assert source.frame(EVENT + step).images.tobytes() == source.frame(EVENT - step).images.tobytes()


def test_what_bounces_meets_the_floor_at_the_event_with_constant_speed() -> None:
    steps = np.diff(track(scene("bounce")), axis=0)[:12]
    assert track(scene("bounce"))[EVENT, 2] == pytest.approx(0.18), "its radius: it touches the floor"
    np.testing.assert_allclose(np.abs(steps[:, 2]), 0.08, atol=1e-9)
    np.testing.assert_array_equal(np.sign(steps[:, 2]), [-1] * EVENT + [1] * 7)
    # Nothing at rest is where it passes.
    assert track(scene("bounce", event=13))[:, 2].max() <= 0.18 + 0.72 + 1e-9


def test_what_is_hidden_is_hidden_from_every_camera_and_comes_out_again() -> None:
    source = scene("occlusion")
    seen = [source.moving_mask(t).any((1, 2)) for t in range(20)]
    assert seen[0].sum() >= 2
    assert not np.array([seen[t] for t in range(EVENT, EVENT + 5)]).any(), "hidden from all of them"
    assert seen[16].sum() >= 2


def test_a_flash_lights_one_frame_of_all_cameras_and_moves_nothing() -> None:
    flash, paths = scene("flash"), scene("paths")
    for index in (0, EVENT - 1, EVENT + 1, 19):
        assert flash.frame(index).images.tobytes() == paths.frame(index).images.tobytes()
    for split in ("train", "test"):
        dark, bright = paths.frame(EVENT, split).images, flash.frame(EVENT, split).images
        np.testing.assert_allclose(bright, np.minimum(1.6 * dark, 1), atol=1.6 / 255)


def test_nothing_happens_where_nothing_moves_and_a_wrong_name_is_explained() -> None:
    for name in ("stop", "reversal", "bounce", "occlusion"):
        still = scene(name, static=1)
        assert still.frame(0).images.tobytes() == still.frame(19).images.tobytes(), name
    with pytest.raises(SourceError, match="option 'scene' = 'stops'"):
        scene("stops")
