"""The adapter for PlayCanvas, with the real engine: its pictures against the Python player, and what a drag does."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from browser_runs import in_browser, needs_browser, serving
from moving_scenes import make_gaussians, make_meta, moving_packets
from pictures import decoded, drawn, psnr

from gsstream.core.changes import Layout
from gsstream.packet import EncodedPacket, KeyState, StreamWriter, encode_key
from gsstream.player.playback import Playback
from gsstream.serve.package import package

ROOT = Path(__file__).parents[2]
MODULES = Path(os.environ.get("GSSTREAM_NODE_MODULES", ROOT / "node_modules"))
pytestmark = [
    needs_browser,
    pytest.mark.skipif(
        not (MODULES / "playcanvas" / "package.json").is_file(),
        reason="playcanvas is missing in node_modules (npm install playcanvas, or @playcanvas/splat-transform)",
    ),
]
#: The engine sorts in a worker and shows the order a picture later, so several are drawn.
PICTURE = """(async () => {{
  stream.player.pause(); stream.player.look(0); ring.enabled = false; stream.player.seek({frame});
  const canvas = app.graphicsDevice.canvas;
  Object.assign(canvas.style, {{ width: "{width}px", height: "{height}px" }});
  app.resizeCanvas();
  while (stream.player.frame !== {frame}) await new Promise(requestAnimationFrame);
  for (let i = 0; i < 12; i += 1) {{
    await new Promise((resolve) => app.once("frameend", resolve));
    await new Promise((resolve) => setTimeout(resolve, 60));
  }}
  const data = new Uint8Array({width} * {height} * 4);
  await new Promise((resolve) => app.once("frameend", () => {{
    const {{ gl }} = app.graphicsDevice;
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.readPixels(0, 0, {width}, {height}, gl.RGBA, gl.UNSIGNED_BYTE, data);
    resolve();
  }}));
  let text = "";
  for (const byte of data) text += String.fromCharCode(byte);
  return btoa(text);
}})()"""


READY = ["until", "typeof stream !== 'undefined' && stream.resource.container && stream.player.pivot"]


@contextlib.contextmanager
def page(tmp_path: Path, packets: list[EncodedPacket]) -> Iterator[str]:
    """Serve the example with a stream; yields its address."""
    with StreamWriter.open(tmp_path / "s.gss") as writer:
        for packet in packets:
            writer.append(packet)
    package(tmp_path / "s.gss", tmp_path / "page" / "site")
    for name in ("index.html", "gsstream-playcanvas.js"):
        shutil.copy(ROOT / "docs" / "examples" / "playcanvas" / name, tmp_path / "page")
    (tmp_path / "page" / "node_modules").symlink_to(MODULES)
    with serving(tmp_path / "page") as (url, _):
        yield f"{url}/index.html"


#: The coefficients of harmonics beyond the first, the size of Gaussians as a logarithm, decibels. The engine cuts a
#: splat that is wider than a third of the picture: with some of those it is told by which frame it is nearest to.
CASES = [(0, 0.0, 20), (15, 0.0, 20), (0, -1.5, 38), (15, -1.5, 38)]


def packets_of(rest: int, size: float) -> list[EncodedPacket]:
    """Six frames in which everything changes, twice from a key packet; or one frame of Gaussians of another size."""
    if size == 0:
        return moving_packets(seed=9, frames=6, number=300, sh_rest=rest, key_at=5, lights=False)
    gaussians = make_gaussians(np.random.default_rng(9), 300, rest)
    smaller = dataclasses.replace(gaussians, scales=gaussians.scales + np.float32(size))
    layout = Layout(np.int32([300]), np.zeros(300, np.uint8), np.float32([1.0]))
    return [encode_key(KeyState(smaller, layout, make_meta()), frame=0)]


@pytest.mark.parametrize(("rest", "size", "least"), CASES)
def test_pictures(tmp_path, rest, size, least):
    packets = packets_of(rest, size)
    rig = make_meta().test
    frames = [0, 3, 5] if len(packets) > 1 else [0]
    ask = [["evaluate", PICTURE.format(width=rig.width, height=rig.height, frame=frame)] for frame in frames]
    with page(tmp_path, packets) as url, Playback(tmp_path / "s.gss") as playback:
        results = in_browser([["go", url], READY, *ask], tmp_path, size=(400, 300))
        wanted = [drawn(playback, frame) for frame in frames]
    for k, text in enumerate(results[2:]):
        picture = decoded(text, rig.width, rig.height)[::-1]
        found = [psnr(one, picture) for one in wanted]
        print(rest, size, frames[k], found)
        assert found[k] >= least
        assert found[k] == max(found)


def test_a_view_outside_of_the_recorded_region_fades_and_springs_back(tmp_path):
    eye = ["evaluate", "[camera.getPosition().x, camera.getPosition().y, camera.getPosition().z]"]
    opacity = "Number(app.graphicsDevice.canvas.style.opacity)"
    steps = [
        READY,
        ["until", f"{opacity} === 1"],
        eye,
        ["hold", 60, 60, 300, 0],
        ["until", f"{opacity} < 1"],
        eye,
        ["evaluate", opacity],
        ["release", 360, 60],
        ["until", f"{opacity} === 1"],
        eye,
        ["evaluate", "[...stream.resource.background, camera.camera.clearColor.r]"],
    ]
    with page(tmp_path, packets_of(0, 0.0)) as url:
        results = in_browser([["go", url], *steps], tmp_path, size=(400, 300))
    before, held, faded, back, (*background, red) = (results[i] for i in (3, 6, 7, 10, 11))
    assert math.dist(before, held) > 0.01, "a drag turns"
    assert 0.4 <= faded < 1
    assert math.dist(held, back) > 0.01, "and springs back"
    assert background == pytest.approx(make_meta().background)
    assert red == pytest.approx(background[0])
