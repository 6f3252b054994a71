"""The player: its renderer, its camera paths, the pictures it writes, and that it needs no torch."""

from __future__ import annotations

import dataclasses
import importlib.metadata
import warnings

import numpy as np
import pytest
from PIL import Image

from gsstream.core.cameras import Cameras
from gsstream.core.changes import Delta, Layout, Residual
from gsstream.core.errors import InputError, OutputError, ShapeError
from gsstream.core.focus import focus_point
from gsstream.core.gaussians import Gaussians
from gsstream.core.world import IDENTITY
from gsstream.packet import KeyState, StreamMeta, StreamWriter, encode_delta, encode_empty, encode_key
from gsstream.player.paths import camera_path
from gsstream.player.play import play
from gsstream.player.playback import Playback
from gsstream.player.render import PlayerRenderer, SlowRendererWarning, find_renderer, render, to_bytes
from gsstream.player.software import render_numpy
from tests.rigs import looking

NUMPY = PlayerRenderer("numpy", render_numpy)


def make_scene(seed=0, number=150, sh_rest=8, spread=0.6):
    rng = np.random.default_rng(seed)
    return Gaussians(
        means=(spread * rng.normal(size=(number, 3))).astype(np.float32),
        quats=rng.normal(size=(number, 4)).astype(np.float32),
        scales=(0.7 * rng.normal(size=(number, 3)) - 2.5).astype(np.float32),
        opacities=(3 * rng.normal(size=number) + 1).astype(np.float32),
        sh0=(0.8 * rng.normal(size=(number, 1, 3))).astype(np.float32),
        shN=(0.1 * rng.normal(size=(number, sh_rest, 3))).astype(np.float32),
    )


def look_at(centers, target=(0.0, 0.0, 0.0), up=(0.0, 0.0, 1.0), near=0.01):
    return looking(centers, target, up, [[60.0, 0, 33], [0, 62.0, 21], [0, 0, 1]], (71, 45), near)


ARC = [(3 * np.cos(a), 3 * np.sin(a), 1.0) for a in (-0.6, -0.2, 0.2, 0.6)]


def make_stream(path, frames=5, world=IDENTITY, scene=None):
    rng, rig = np.random.default_rng(1), look_at(ARC)
    meta = StreamMeta("dense", "test", {}, rig.select([0, 1, 2]), rig.select([3]), 25.0, (0.1, 0.2, 0.3), world=world)
    scene = make_scene() if scene is None else scene
    layout = Layout(np.ones(len(scene), np.int32), np.zeros(len(scene), np.uint8), np.float32([1]))
    with StreamWriter.open(path) as writer:
        writer.append(encode_key(KeyState(scene, layout, meta)))
        for frame in range(1, frames):
            gates = (rng.random(len(scene)) < 0.3).astype(np.uint8)
            moves = {"means": rng.integers(-9, 10, (int(gates.sum()), 3)).astype(np.int32)}
            delta = encode_delta(Delta((Residual(gates, 1, moves, {"means": 0.02}),)), layout, {}, frame=frame)
            writer.append(encode_empty(frame=frame) if frame == 2 else delta)
    return path


def test_nothing_between_the_near_plane_and_the_camera_is_drawn():
    """One opaque ball one unit in front of the camera: drawn with the near plane before it, gone with it behind."""
    rig = look_at(ARC)
    middle = np.float32(ARC[0]) * (1 - 1 / np.linalg.norm(ARC[0])).astype(np.float32)
    ball = dataclasses.replace(
        make_scene(6, 1), means=middle[None], scales=np.full((1, 3), -2, np.float32), opacities=np.float32([9])
    )
    drawn, gone = (render(ball, dataclasses.replace(rig, near_plane=near), 0, renderer=NUMPY) for near in (0.99, 1.01))
    assert drawn.max() > 0.1
    assert gone.max() == 0
    assert render(ball, dataclasses.replace(rig, near_plane=1.01), 0).max() == 0, "the renderer that is installed"


def test_an_empty_or_invisible_scene_shows_the_background():
    rig = look_at(ARC)
    scene = make_scene(4)
    behind = dataclasses.replace(scene, means=(scene.means * 0.1 + 2 * np.float32(ARC[0])).astype(np.float32))
    clear = dataclasses.replace(scene, opacities=np.full(len(scene), -9, np.float32))
    for nothing in (scene.rows(slice(0, 0)), behind, clear):
        image = render(nothing, rig, 0, (0.25, 0.5, 0.75), NUMPY)
        assert np.array_equal(image, np.broadcast_to(np.float32([0.25, 0.5, 0.75]), image.shape))


def test_a_renderer_that_returns_nonsense_is_named():
    liar = PlayerRenderer("liar", lambda *_, **__: np.zeros((3, 3, 3)))
    with pytest.raises(ShapeError, match="liar"):
        render(make_scene(), look_at(ARC), 0, renderer=liar)


def broken_renderer():
    """A target for an entry point with the wrong signature."""


@pytest.fixture
def entry_points(monkeypatch):
    points = []
    monkeypatch.setattr(importlib.metadata, "entry_points", lambda group: [p for p in points if p.group == group])
    find_renderer.cache_clear()
    yield points
    find_renderer.cache_clear()


def test_a_compiled_renderer_is_preferred_and_broken_ones_are_reported(entry_points):
    def point(name, value):
        return importlib.metadata.EntryPoint(name, value, "gsstream.player")

    entry_points.append(point("a-missing", "no_such_module_anywhere:render"))
    entry_points.append(point("b-other-signature", f"{__name__}:broken_renderer"))
    with pytest.warns(SlowRendererWarning, match=r"a-missing .* ModuleNotFoundError.*b-other-signature .* TypeError"):
        assert find_renderer().render_numpy is render_numpy
    find_renderer.cache_clear()
    entry_points.append(point("c-good", "gsstream.player.software:render_numpy"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert find_renderer().name == "c-good"


def test_without_a_compiled_renderer_there_is_one_warning(entry_points):
    with pytest.warns(SlowRendererWarning, match="install"):
        find_renderer()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        render(make_scene(), look_at(ARC), 0)
    assert entry_points == []


@pytest.mark.parametrize("kind", ["orbit", "spiral"])
@pytest.mark.parametrize("ring", [False, True])
def test_paths_are_valid_rigs_that_look_at_the_focus(kind, ring):
    angles = np.linspace(0, 2 * np.pi, 8, endpoint=False) if ring else np.linspace(-0.6, 0.6, 8)
    target = np.array([0.3, -0.2, 0.1])
    rig = look_at([target + np.array([3 * np.cos(a), 3 * np.sin(a), 1.5]) for a in angles], target, near=0.2)
    assert focus_point(rig) == pytest.approx(target, abs=3e-3)
    target = focus_point(rig)
    path = camera_path(kind, rig, 12)
    path.validate()
    assert (len(path), path.width, path.height, path.near_plane) == (12, rig.width, rig.height, 0.2)
    seen = np.einsum("cij,j->ci", path.viewmats[:, :3, :3], target) + path.viewmats[:, :3, 3]
    assert np.abs(seen[:, :2]).max() < 1e-9
    assert seen[:, 2].min() > 1
    assert -path.viewmats[:, 1, 2].min() > 0  # the world's up stays up
    if kind == "orbit":
        assert path.centers[:, 2] == pytest.approx(np.full(12, 1.6), abs=1e-3)
        distance = np.linalg.norm(rig.centers - target, axis=1).mean()
        assert np.linalg.norm(path.centers - target, axis=1) == pytest.approx(np.full(12, distance), rel=1e-6)


@pytest.mark.parametrize("kind", ["orbit", "spiral"])
def test_paths_of_one_camera_or_parallel_cameras_are_valid(kind):
    one = look_at([(3.0, 0, 1)])
    parallel = Cameras(("a", "b"), np.tile(np.eye(4), (2, 1, 1)), np.tile(one.Ks[0], (2, 1, 1)), 64, 48)
    parallel.viewmats[1, 0, 3] = 0.5
    for rig in (one, parallel):
        camera_path(kind, rig, 7).validate()


def test_unknown_paths_and_cameras_are_refused(tmp_path):
    with pytest.raises(ShapeError, match="orbit, spiral"):
        camera_path("loop", look_at(ARC), 3)
    stream = make_stream(tmp_path / "s.gss")
    with pytest.raises(InputError, match="cam3"):
        play(stream, tmp_path / "out", camera="nobody", renderer=NUMPY)
    with pytest.raises(InputError, match="frame 5"):
        play(stream, tmp_path / "out", frames=[5], renderer=NUMPY)
    with pytest.raises(InputError, match="no frames"):
        play(stream, tmp_path / "out", frames=[], renderer=NUMPY)


def test_pngs_are_the_decoded_frames(tmp_path):
    stream = make_stream(tmp_path / "s.gss")
    ticks = []
    played = play(stream, tmp_path / "out", camera="cam1", renderer=NUMPY, progress=lambda *t: ticks.append(t))
    assert played.frames == 5
    assert ticks[-1] == (5, 5)
    files = sorted((tmp_path / "out").iterdir())
    assert [f.name for f in files] == [f"{i:06d}.png" for i in range(5)]
    with Playback(stream) as playback:
        rig = playback.meta.camera("cam1")
        for frame, file in enumerate(files):
            expected = to_bytes(render(playback.state_at(frame), rig, 0, (0.1, 0.2, 0.3), NUMPY))
            assert np.array_equal(np.asarray(Image.open(file)), expected)
    assert files[1].read_bytes() == files[2].read_bytes() != files[3].read_bytes()


def test_frames_are_shown_in_the_order_asked_for(tmp_path):
    stream = make_stream(tmp_path / "s.gss")
    play(stream, tmp_path / "all", renderer=NUMPY)
    play(stream, tmp_path / "some", frames=[3, 1], renderer=NUMPY)
    for name in ("000003.png", "000001.png"):
        assert (tmp_path / "some" / name).read_bytes() == (tmp_path / "all" / name).read_bytes()


@pytest.mark.parametrize("suffix", [".webp", ".gif"])
def test_animations_have_every_frame(tmp_path, suffix):
    stream = make_stream(tmp_path / "s.gss")
    played = play(stream, tmp_path / f"a{suffix}", camera="spiral", renderer=NUMPY)
    with Image.open(played.path) as image:
        assert (image.size, image.n_frames) == ((71, 45), 5)


def test_video_holds_the_frames(tmp_path):
    av = pytest.importorskip("av")
    stream = make_stream(tmp_path / "s.gss")
    played = play(stream, tmp_path / "v.mp4", camera="cam0", renderer=NUMPY)
    with av.open(str(played.path)) as container:
        frames = np.stack([f.to_ndarray(format="rgb24")[:45, :71] for f in container.decode(video=0)]).astype(float)
    assert len(frames) == played.frames == 5
    with Playback(stream) as playback:
        camera = playback.meta.camera("cam0")
        pictures = [render(playback.state_at(i), camera, 0, (0.1, 0.2, 0.3), NUMPY) for i in range(5)]
    difference = np.abs(frames[:, None] - np.stack([to_bytes(picture) for picture in pictures])).mean((2, 3, 4))
    assert difference.diagonal().max() < 6  # lossy, but that picture
    assert difference.argmin(1).tolist() == [0, 1, 1, 3, 4], "frame 2 shows what frame 1 did"


def test_video_without_pyav_is_refused_with_what_can_be_written(tmp_path, monkeypatch):
    monkeypatch.setattr("gsstream.player.play.importlib.util.find_spec", lambda _: None)
    stream = make_stream(tmp_path / "s.gss")
    with pytest.raises(OutputError, match=r"PyAV, which is not installed: .*'gsstream\[video\]'.*v\.webp"):
        play(stream, tmp_path / "v.mp4", frames=[0], renderer=NUMPY)
    assert not (tmp_path / "v").exists()
