"""A headset, emulated by iwer in a real browser: both eyes, what hands do, and sessions and contexts that end."""

from __future__ import annotations

import base64
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from browser_runs import MESSAGE, PLAYER, ROOT, at, in_browser, needs_browser, serving, try_in_browser
from pictures import psnr

from gsstream.core.cameras import Cameras
from gsstream.player.playback import Playback
from gsstream.player.render import PlayerRenderer, render, to_bytes
from gsstream.player.software import render_numpy

MODULES = Path(os.environ.get("GSSTREAM_NODE_MODULES", Path(__file__).parents[2] / "node_modules"))
needs_iwer = pytest.mark.skipif(
    not (MODULES / "iwer").is_dir(), reason="iwer is missing in node_modules (npm install iwer)"
)
ELEMENT = "document.querySelector('gsstream-player')"
HEADSET = f"{ELEMENT}.headset"
#: A device before the player looks for one; EYES says whether it shows one or two.
DEVICE = """<!doctype html><style>body { margin: 0 }</style><script type="module">
import { XRDevice, metaQuest3 } from "./iwer.module.js";
const device = new XRDevice(metaQuest3);
device.installRuntime({ forceInstall: true });
device.stereoEnabled = EYES;
device.position.set(0, 1.6, 0);
device.quaternion.set(0, 0, 0, 1);
window.device = device;
await import("./element.js");
</script><gsstream-player src="stream.json" style="width: 400px"></gsstream-player>"""
ENTER = [
    ["go", "URL/headset.html"],
    ["until", f"{PLAYER}?.drew"],
    ["until", f"!{ROOT}.querySelector('.headset').hidden"],
    ["evaluate", f"{ROOT}.querySelector('.headset').click()"],
    ["until", f"{HEADSET}?.pictures > 3"],
]
#: Both eyes as they are in the headset, then each by the ordinary way of the player at the size of its window.
EYES = f"""(async () => {{
  const headset = {HEADSET}, {{ renderer }} = {PLAYER}, {{ gl }} = renderer;
  headset.exact = true;
  const read = ({{ x, y, width, height }}) => {{
    const bytes = new Uint8Array(4 * width * height);
    gl.readPixels(x, y, width, height, gl.RGBA, gl.UNSIGNED_BYTE, bytes);
    return bytes;
  }};
  const eyes = await new Promise((resolve) => {{
    let last = headset.pictures;
    headset.onPicture = () => {{
      if (headset.pictures < last + 2) return;
      headset.onPicture = null;
      gl.bindFramebuffer(gl.FRAMEBUFFER, headset.layer.framebuffer);
      resolve(headset.cameras.map(({{ window, camera, eye }}) => ({{ eye, camera, bytes: read(window) }})));
    }};
  }});
  await headset.leave();
  const text = (bytes) => btoa(Array.from(bytes, (byte) => String.fromCharCode(byte)).join(""));
  return eyes.map(({{ eye, camera, bytes }}, i) => {{
    const {{ width, height }} = camera;
    Object.assign(renderer.canvas, {{ width, height }});
    // One order for both eyes: that of the first.
    if (i === 0) renderer.draw(camera, {{ exact: true }});
    else renderer.paint(camera, {{ framebuffer: null, x: 0, y: 0, width, height }});
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    const plain = read({{ x: 0, y: 0, width, height }});
    renderer.draw(camera, {{ exact: true }});
    const own = read({{ x: 0, y: 0, width, height }});
    const apart = (a, b) => a.reduce((worst, v, k) => Math.max(worst, Math.abs(v - b[k])), 0);
    return {{ eye, camera, picture: text(bytes), plain: apart(bytes, plain), own: apart(bytes, own) }};
  }});
}})()"""


@pytest.fixture
def room(site):
    """The packaged stream with a page for a device of two eyes."""
    shutil.copy(MODULES / "iwer" / "build" / "iwer.module.js", site)
    (site / "headset.html").write_text(DEVICE.replace("EYES", "true"))
    return site


def look(room: Path, tmp_path: Path, steps: list, **settings: object) -> list:
    with serving(room) as (url, _):
        return in_browser(at(url, [*ENTER, *steps]), tmp_path, **settings)[len(ENTER) :]


@needs_browser
@needs_iwer
def test_both_eyes_are_the_ordinary_pictures_of_their_cameras(room, tmp_path):
    (eyes,) = look(room, tmp_path, [["evaluate", EYES]])
    left, right = eyes
    assert [left["eye"], right["eye"]] == ["left", "right"]
    assert (left["plain"], right["plain"]) == (0, 0)
    assert left["own"] == 0
    assert left["camera"]["viewmat"][3] != right["camera"]["viewmat"][3]
    with Playback(room / "stream.gss") as playback:
        for eye in eyes:
            camera = eye["camera"]
            width, height = camera["width"], camera["height"]
            data = np.frombuffer(base64.b64decode(eye["picture"]), np.uint8)
            picture = data.reshape(height, width, 4)[::-1, :, :3]
            K = np.array([[camera["fx"], 0, camera["cx"]], [0, camera["fy"], camera["cy"]], [0, 0, 1.0]])
            viewmat = np.array(camera["viewmat"], dtype=np.float64).reshape(4, 4)
            rig = Cameras(("eye",), viewmat[None], K[None], width, height, camera["near"])
            numpy = PlayerRenderer("numpy", render_numpy)
            scene, background = playback.state_at(0), playback.meta.background
            expected = to_bytes(render(scene, rig, 0, background, numpy, scale=camera["scale"]))
            found = psnr(expected, picture)
            print(eye["eye"], found)
            assert expected.std() > 10, "a picture of nothing tests little"
            assert found >= 60


@needs_browser
@needs_iwer
def test_a_device_of_one_eye_gets_one(room, tmp_path):
    (room / "headset.html").write_text(DEVICE.replace("EYES", "false"))
    (eyes,) = look(room, tmp_path, [["evaluate", EYES]])
    assert [eye["plain"] for eye in eyes] == [0]


@needs_browser
@needs_iwer
def test_a_stream_plays_and_seeks_for_120_pictures_and_the_page_comes_back(room, tmp_path):
    state = f"[{HEADSET}.pictures, {HEADSET}.session, {PLAYER}.driver, {PLAYER}.problem]"
    drawn = ["evaluate", f"{PLAYER}.statistics.drawn"]
    steps = [
        ["evaluate", f"{PLAYER}.play()"], ["until", f"{PLAYER}.frame > 3"], ["until", f"{HEADSET}.pictures > 60"],
        ["evaluate", f"{PLAYER}.pause(), {PLAYER}.seek(9)"], ["until", f"{PLAYER}.frame === 9"],
        ["evaluate", f"{PLAYER}.seek(2)"], ["until", f"{PLAYER}.frame === 2 && {HEADSET}.pictures >= 120"],
        ["evaluate", f"{HEADSET}.leave()"], ["until", f"!{HEADSET}.session"], ["evaluate", state], drawn,
        ["evaluate", f"{PLAYER}.seek(5)"], ["until", f"{PLAYER}.frame === 5"], ["pause", 500], drawn,
    ]  # fmt: skip
    results = look(room, tmp_path, steps)
    pictures, session, driver, problem = results[9]
    assert pictures >= 120
    assert (session, driver, problem) == (None, None, None)
    assert results[14] > results[10], "the page draws again"


@needs_browser
@needs_iwer
def test_a_lost_context_ends_the_session_and_the_page_goes_on(room, tmp_path):
    steps = [
        ["evaluate", f"window.loss = {PLAYER}.renderer.gl.getExtension('WEBGL_lose_context'), loss.loseContext()"],
        ["until", f"!{HEADSET}.session"],
        ["evaluate", "loss.restoreContext()"],
        ["pause", 500],
        ["picture", 3, 32, 24],
        ["evaluate", MESSAGE],
    ]
    with serving(room) as (url, _):
        results, messages = try_in_browser(at(url, [*ENTER, *steps]), tmp_path)
    assert all("iwer.module.js" in text for text in messages), "the emulator itself reads from a lost context"
    assert results[-1] == ""
    assert len(set(base64.b64decode(results[-2]))) > 10, "a picture, not one colour"


@needs_browser
@needs_iwer
def test_hands_move_and_heads_that_leave_are_not_pushed(room, tmp_path):
    place = [
        "evaluate",
        f"(({{ m11, m12, m13, m41, m42, m43 }}) => [[m41, m42, m43], Math.hypot(m11, m12, m13)])({HEADSET}.place)",
    ]
    hand = "device.controllers.right"
    later = ["until", f"{HEADSET}.pictures > window.since + 6"]
    since = f"window.since = {HEADSET}.pictures"
    steps = [
        place, ["evaluate", f"{hand}.position.set(0.2, 1.4, -0.3), {hand}.updateButtonValue('trigger', 1), {since}"],
        later,
        ["evaluate", f"{hand}.position.set(0.5, 1.5, -0.3), {since}"], later, place,
        ["evaluate", f"{hand}.updateButtonValue('trigger', 0), device.position.set(0, 1.6, 30), {since}"], later,
        ["evaluate", f"{HEADSET}._outside({{ position: device.position }})"], place,
    ]  # fmt: skip
    results = look(room, tmp_path, steps)
    (before, scale), (after, same), outside, (kept, _) = (results[i] for i in (0, 5, 8, 9))
    assert np.subtract(after, before) == pytest.approx([0.3, 0.1, 0], abs=0.02)
    assert same == pytest.approx(scale)
    assert outside == 1
    assert kept == after


@needs_browser
def test_without_a_device_there_is_no_button_and_without_https_a_sentence(site, tmp_path):
    hidden = f"{ROOT}.querySelector('.headset').hidden"
    with serving(site) as (url, _):
        steps = [
            ["go", f"{url}/index.html?xr=vr"],
            ["until", f"{PLAYER}?.drew"],
            ["pause", 300],
            ["evaluate", hidden],
            ["go", f"{url.replace('127.0.0.1', 'other.test')}/index.html?xr=vr"],
            ["until", f"{PLAYER}?.drew"],
            ["until", f"!{hidden}"],
            ["evaluate", f"{ROOT}.querySelector('.headset').click()"],
            ["until", MESSAGE],
            ["evaluate", MESSAGE],
            ["go", f"{url.replace('127.0.0.1', 'other.test')}/index.html"],
            ["until", f"{PLAYER}?.drew"],
            ["pause", 300],
            ["evaluate", hidden],
        ]
        results = in_browser(steps, tmp_path, flags=["--host-resolver-rules=MAP other.test 127.0.0.1"])
    assert results[3] is True
    assert "https" in results[9]
    assert results[-1] is True


@needs_browser
def test_what_hands_hold_stays_in_them(site, tmp_path):
    """Two points of the stream lie in the hands before and after, whatever the hands do about the vertical."""
    rng = np.random.default_rng(3)
    cases = []
    for _ in range(20):
        q, _r = np.linalg.qr(rng.normal(size=(3, 3)))
        place = np.eye(4)
        place[:3, :3], place[:3, 3] = 0.7 * q * np.sign(np.linalg.det(q)), rng.normal(size=3)
        start = rng.normal(size=(2, 3))
        start[1, 1] = start[0, 1]
        angle, factor = rng.uniform(-3, 3), rng.uniform(0.5, 2)
        turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        end = factor * start @ turn.T + rng.normal(size=3)
        cases.append((place, start, end))
    given = json.dumps([[place.T.ravel().tolist(), *map(np.ndarray.tolist, hands)] for place, *hands in cases])
    code = f"""import('./xr.js').then(({{ grabbed }}) => {given}.map(
      ([place, from, to]) => Array.from(grabbed(new DOMMatrix(place), from, to).toFloat64Array())))"""
    with serving(site) as (url, _):
        found = in_browser([["go", f"{url}/index.html"], ["evaluate", code]], tmp_path)[-1]
    for (place, start, end), numbers in zip(cases, found, strict=True):
        after = np.reshape(numbers, (4, 4)).T
        assert after[3] == pytest.approx([0, 0, 0, 1])
        turned = after[:3, :3] / np.cbrt(np.linalg.det(after[:3, :3]))
        assert turned @ turned.T == pytest.approx(np.eye(3), abs=1e-6)
        assert turned[1] == pytest.approx(place[1, :3] / 0.7, abs=1e-6), "the floor stays level"
        held = np.linalg.solve(place[:3, :3], (start - place[:3, 3]).T).T
        assert held @ after[:3, :3].T + after[:3, 3] == pytest.approx(end, abs=1e-6)
