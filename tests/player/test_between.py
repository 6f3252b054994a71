"""Moments between frames: what moved is on its way, everything else is the frame before, whole frames are exact."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation, Slerp
from test_player import NUMPY, make_scene, make_stream

from gsstream.core.changes import Delta, Layout, Residual, RowEdit, Scene, apply_delta
from gsstream.core.errors import InputError
from gsstream.packet import PlayerState
from gsstream.player.interpolation import Moments, frame_times, interpolate
from gsstream.player.play import play
from gsstream.player.playback import Playback


def two_frames(rows: RowEdit | None = None) -> tuple[PlayerState, PlayerState]:
    """A frame, and one in which every second Gaussian goes and turns; opacities name the rows."""
    gaussians, rng = make_scene(4, 20), np.random.default_rng(2)
    gaussians.opacities[:] = np.arange(20)
    layout = Layout(np.ones(20, np.int32), np.zeros(20, np.uint8), np.float32([1]))
    gates = (np.arange(20) % 2 == 0).astype(np.uint8)
    symbols = {name: rng.integers(-9, 10, (10, size)).astype(np.int32) for name, size in (("means", 3), ("quats", 4))}
    delta = Delta((Residual(gates, 1, symbols, {"means": 0.1, "quats": 0.05}),)).with_row_edit(rows)
    before = Scene(gaussians, layout)
    return PlayerState(3, before, None), PlayerState(4, apply_delta(before, delta), None, {}, delta, layout)


def rotation(quats: np.ndarray) -> Rotation:
    return Rotation.from_quat(quats[[1, 2, 3, 0]].astype(float))


@pytest.mark.parametrize("share", [0.25, 0.5, 0.999])
def test_rows_go_straight_and_turn_evenly(share: float) -> None:
    """Turns against scipy's spherical interpolation."""
    before, after = two_frames()
    scene = interpolate(before, after, share)
    expected = (1 - share) * before.gaussians.means + share * after.gaussians.means
    np.testing.assert_allclose(scene.means, expected, atol=1e-6)
    for row in range(20):
        ends = Rotation.concatenate([rotation(before.gaussians.quats[row]), rotation(after.gaussians.quats[row])])
        if ends[0].inv().__mul__(ends[1]).magnitude() > 2.0:
            continue  # more than 120 degrees: painted anew, not turned
        apart = (Slerp([0, 1], ends)(share).inv() * rotation(scene.quats[row])).magnitude()
        assert apart < 1e-3, row
    lengths = [np.linalg.norm(s.quats, axis=1) for s in (before.gaussians, scene)]
    np.testing.assert_allclose(*lengths, rtol=1e-5)
    for name in ("scales", "opacities", "sh0", "shN"):
        assert getattr(scene, name) is getattr(before.gaussians, name), f"{name} wait for their frame"


def test_rows_are_found_again_when_others_leave() -> None:
    before, after = two_frames(RowEdit(None, np.array([0, 3, 8])))
    scene = interpolate(before, after, 0.5)
    assert len(scene) == 20, "who leaves is there until the next frame"
    here = {name: row for row, name in enumerate(after.gaussians.opacities)}
    for row, name in enumerate(before.gaussians.opacities):
        start = before.gaussians.means[row]
        end = after.gaussians.means[here[name]] if name in here else start
        np.testing.assert_allclose(scene.means[row], (start + end) / 2, atol=1e-6)
    assert (scene.means != before.gaussians.means).any(1).sum() == 8, "ten went, two of them have left"


def test_before_a_key_packet_and_at_a_frame_nothing_is_on_its_way() -> None:
    before, after = two_frames()
    assert interpolate(before, after, 0.0) is before.gaussians
    key = PlayerState(4, Scene(after.gaussians, after.layout), None)
    assert interpolate(before, key, 0.5) is before.gaussians


def test_twice_the_pictures_show_the_frames_and_moments_between_them(tmp_path) -> None:
    stream = make_stream(tmp_path / "s.gss")  # 5 frames at 25 a second; the packet of frame 2 is empty
    play(stream, tmp_path / "plain", renderer=NUMPY)
    assert play(stream, tmp_path / "twice", renderer=NUMPY, fps=50).frames == 9
    plain = [np.asarray(Image.open(tmp_path / "plain" / f"{t:06d}.png")).astype(int) for t in range(5)]
    twice = [np.asarray(Image.open(tmp_path / "twice" / f"{t:06d}.png")).astype(int) for t in range(9)]
    for frame in range(5):
        np.testing.assert_array_equal(twice[2 * frame], plain[frame])
    assert (twice[1] != plain[0]).any()
    assert (twice[1] != plain[1]).any()
    np.testing.assert_array_equal(twice[3], plain[1])
    with pytest.raises(InputError, match="follow each other"):
        play(stream, tmp_path / "no", renderer=NUMPY, fps=50, frames=[3, 1])
    with pytest.raises(InputError, match="expected 1 to 1000, got 0"):
        play(stream, tmp_path / "no", renderer=NUMPY, fps=0)


def test_moments_come_in_any_order(tmp_path) -> None:
    with Playback(make_stream(tmp_path / "s.gss")) as playback:
        scenes = Moments(playback)
        forward = {time: scenes.at(time).means for time in (0.0, 0.5, 1.0, 2.25, 2.75, 3.0, 4.0)}
        for time in (2.75, 0.5, 4.0, 2.25, 0.0):
            np.testing.assert_array_equal(scenes.at(time).means, forward[time])
        assert scenes.at(3.0) is playback.state_at(3) or (scenes.at(3.0).means == playback.state_at(3).means).all()


def test_times_keep_the_speed() -> None:
    assert frame_times(range(2, 5), 30, 60) == [2, 2.5, 3, 3.5, 4]
    assert frame_times(range(0, 4), 30, 20) == [0, 1.5, 3]
    assert frame_times(range(7, 8), 30, 60) == [7]
    times = frame_times(range(0, 91), 30, 29.97)
    assert times[-1] <= 90
    assert times[1] == pytest.approx(30 / 29.97)
