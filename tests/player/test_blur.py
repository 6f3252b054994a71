"""Pictures larger than the recorded ones: as smooth as the recorded picture, enlarged."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image
from test_player import ARC, NUMPY, look_at, make_scene, make_stream

from gsstream.player.blur import enlarged
from gsstream.player.paths import resized
from gsstream.player.play import choose_cameras, play
from gsstream.player.playback import Playback
from gsstream.player.render import render, to_bytes
from gsstream.player.software import _project


def footprints(scene, rig, view):
    """[N, 3] covariances in the picture, blur included, of what lies before a camera."""
    points = scene.means.astype(np.float64) @ rig.viewmats[view, :3, :3].T + rig.viewmats[view, :3, 3]
    front = points[:, 2] > 0.1
    size = {"width": rig.width, "height": rig.height}
    drawn = (points[front], scene.quats[front], scene.scales[front])
    return _project(*drawn, viewmat=rig.viewmats[view], K=rig.Ks[view], **size)[1]


@pytest.mark.parametrize("scale", [1.5, 4, 20])
@pytest.mark.parametrize("seed", range(3))
def test_a_footprint_is_that_of_the_recorded_picture_enlarged(seed, scale):
    """Also beside the picture, where the projection is limited, and with pixels that are not square."""
    rig = look_at(ARC)
    scene = make_scene(seed, 300, spread=1.5)
    scene.scales[:100] -= 6
    scene.scales[100:200, 0] -= 12
    larger = rig.scaled(rig.width * scale, rig.height * scale)
    for view in range(len(rig)):
        found = footprints(enlarged(scene, larger.viewmats[view], larger.Ks[view], scale), larger, view)
        wanted = scale**2 * footprints(scene, rig, view)
        most = wanted[:, [0, 2]].max(1, keepdims=True)
        assert found / most == pytest.approx(wanted / most, abs=1e-4)


@pytest.mark.parametrize("scale", [0.25, 1])
def test_the_recorded_size_and_smaller_ones_change_nothing(scale):
    rig, scene = look_at(ARC), make_scene()
    assert enlarged(scene, rig.viewmats[0], rig.Ks[0], scale) is scene
    assert np.array_equal(render(scene, rig, renderer=NUMPY), render(scene, rig, renderer=NUMPY, scale=scale))


def test_an_enlarged_picture_is_the_recorded_one_seen_near():
    """Needles: drawn four times as large and averaged back, they cover what they covered in the recording."""
    rig, scene = look_at(ARC), make_scene(4, 400)
    scene.scales[:, 1:] -= 4
    larger = resized(rig, 4 * rig.width, 4 * rig.height)
    recorded = render(scene, rig, renderer=NUMPY)

    def apart(scale: float) -> float:
        picture = render(scene, larger, renderer=NUMPY, scale=scale)
        small = picture.reshape(rig.height, 4, rig.width, 4, 3).mean((1, 3))
        return float(np.sqrt(np.mean((small - recorded) ** 2)))

    assert apart(4) < 0.4 * apart(1)


def test_gaussians_beyond_numbers_are_left_to_the_renderer():
    rig, scene = look_at(ARC), make_scene()
    scene.scales[0] = 800
    scene.quats[1] = 0
    found = enlarged(scene, rig.viewmats[0], rig.Ks[0], 3.0)
    assert np.array_equal(found.scales[0], scene.scales[0])
    assert np.isfinite(found.quats).all()
    assert np.isfinite(found.scales).all()


@pytest.mark.parametrize("camera", [None, "cam1", "orbit", "path.json"])
def test_a_larger_picture_of_the_player_is_that_smooth(tmp_path, monkeypatch, camera):
    monkeypatch.chdir(tmp_path)
    stream = make_stream(tmp_path / "s.gss")
    (tmp_path / "path.json").write_text(json.dumps({"cameras": [{"w2c": look_at(ARC).viewmats[0].tolist()}]}))
    with Playback(stream) as playback:
        name = playback.meta.train.ids[1] if camera == "cam1" else camera
        play(stream, tmp_path / "p", camera=name, frames=[0], size=(142, 90), renderer=NUMPY)
        own = resized(choose_cameras(playback, name, 1), 142, 90)
        scene, background = playback.state_at(0), playback.meta.background
        smooth, sharp = (to_bytes(render(scene, own, 0, background, renderer=NUMPY, scale=s)) for s in (2, 1))
    found = np.asarray(Image.open(tmp_path / "p" / "000000.png"))
    assert np.array_equal(found, smooth)
    assert not np.array_equal(found, sharp)
