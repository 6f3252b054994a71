"""The browser viewer: served for real where viser is installed, a clear message where it is not."""

from __future__ import annotations

import importlib.util
import socket
import time
import urllib.request

import numpy as np
import pytest
from test_player import make_scene, make_stream

from gsstream.core.errors import InputError
from gsstream.player.playback import Playback
from gsstream.player.view import LOOPBACK, Viewer, splats

needs_viser = pytest.mark.skipif(importlib.util.find_spec("viser") is None, reason="viser (extra viewer) is missing")


def test_without_viser_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr("gsstream.player.view.importlib.util.find_spec", lambda _: None)
    with pytest.raises(InputError, match=r"pip install 'gsstream\[viewer\]'"):
        Viewer(make_stream(tmp_path / "s.gss"))


def test_splats_are_the_activated_scene():
    scene = make_scene(8, 30)
    shown = splats(scene)
    for i in range(30):
        w, x, y, z = scene.quats[i] / np.linalg.norm(scene.quats[i])
        skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        rotation = np.eye(3) + 2 * w * skew + 2 * skew @ skew  # Rodrigues' form
        expected = rotation @ np.diag(np.exp(2 * scene.scales[i])) @ rotation.T
        assert shown["covariances"][i] == pytest.approx(expected, rel=1e-4, abs=1e-7)
        assert shown["opacities"][i, 0] == pytest.approx(1 / (1 + np.exp(-float(scene.opacities[i]))), rel=1e-5)
    assert shown["rgbs"].min() >= 0
    assert shown["rgbs"].max() <= 1


@needs_viser
def test_the_page_is_served_on_loopback_and_time_moves(tmp_path):
    stream = make_stream(tmp_path / "s.gss")
    with socket.socket() as probe:
        probe.bind((LOOPBACK, 0))
        port = probe.getsockname()[1]
    with Viewer(stream, port=port) as viewer, Playback(stream) as playback:
        assert viewer.url.startswith(f"http://{LOOPBACK}:")
        with urllib.request.urlopen(viewer.url, timeout=10) as answer:
            assert answer.status == 200
            assert b"<html" in answer.read().lower()
        viewer.show(3)
        assert np.array_equal(viewer._shown.means, playback.state_at(3).means)
        viewer.playing.value = True
        deadline = time.monotonic() + 20
        while viewer.slider.value == 0 and time.monotonic() < deadline:
            time.sleep(0.02)
        assert viewer.slider.value > 0
    viewer.close()  # closing twice is no error
