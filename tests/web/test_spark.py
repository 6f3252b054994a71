"""The adapter for three.js, with the real packages: its pictures against the Python player, and what it uploads."""

from __future__ import annotations

import math
import os
import shutil
from pathlib import Path

import pytest
from browser_runs import in_browser, needs_browser, serving
from moving_scenes import make_meta, moving_packets
from pictures import decoded, drawn, psnr

from gsstream.packet import StreamWriter
from gsstream.player.playback import Playback
from gsstream.serve.package import package

ROOT = Path(__file__).parents[2]
MODULES = Path(os.environ.get("GSSTREAM_NODE_MODULES", ROOT / "node_modules"))
PACKAGES = ("three", "@sparkjsdev/spark")
pytestmark = [
    needs_browser,
    pytest.mark.skipif(
        not all((MODULES / name / "package.json").is_file() for name in PACKAGES),
        reason="three or spark is missing in node_modules (npm install three @sparkjsdev/spark)",
    ),
]
#: Spark sorts in a worker and shows the order one picture later, so several are drawn.
PICTURE = """(async () => {{
  stream.player.pause(); spark.preBlurAmount = 0.3; ring.visible = false; renderer.setAnimationLoop(null);
  renderer.setSize({width}, {height}, false); stream.player.look(0); stream.place(camera);
  stream.player.seek({frame});
  while (stream.player.frame !== {frame}) await new Promise(requestAnimationFrame);
  for (let i = 0; i < 8 || spark.sorting || spark.sortDirty; i += 1) {{
    stream.update(); renderer.render(scene, camera);
    await new Promise((resolve) => setTimeout(resolve, 60));
  }}
  renderer.render(scene, camera);
  const gl = renderer.getContext(), data = new Uint8Array({width} * {height} * 4);
  gl.readPixels(0, 0, {width}, {height}, gl.RGBA, gl.UNSIGNED_BYTE, data);
  let text = "";
  for (const byte of data) text += String.fromCharCode(byte);
  return btoa(text);
}})()"""


def test_pictures_and_uploads(tmp_path):
    stream = tmp_path / "s.gss"
    with StreamWriter.open(stream) as writer:
        for packet in moving_packets(seed=9, frames=6, number=300, sh_rest=3, key_at=99, lights=False):
            writer.append(packet)
    package(stream, tmp_path / "page" / "site")
    for name in ("index.html", "gsstream-spark.js"):
        shutil.copy(ROOT / "docs" / "examples" / "spark" / name, tmp_path / "page")
    (tmp_path / "page" / "node_modules").symlink_to(MODULES)
    rig = make_meta().test
    frames = [0, 3, 5]
    ask = [["evaluate", PICTURE.format(width=rig.width, height=rig.height, frame=frame)] for frame in frames]
    ready = "typeof stream !== 'undefined' && stream.source.uploaded > 0 && ring.rotation.x"
    small = """(async () => {
      stream.player.seek(0);
      while (stream.player.frame !== 0) await new Promise(requestAnimationFrame);
      stream.update();
      const whole = stream.source.uploaded;
      stream.player.seek(1);
      while (stream.player.frame !== 1) await new Promise(requestAnimationFrame);
      stream.update();
      return [whole, stream.source.uploaded, stream.source.getNumSplats()];
    })()"""
    eye = ["evaluate", "camera.position.toArray()"]
    opacity = "Number(renderer.domElement.style.opacity)"
    blur = "[spark.preBlurAmount, spark.uniforms.preBlurAmount.value, renderer.domElement.height]"
    with serving(tmp_path / "page") as (url, _), Playback(stream) as playback:
        steps = [
            ["go", f"{url}/index.html"],
            ["until", ready],
            eye,
            ["drag", 60, 60, 20, 0],
            eye,
            ["evaluate", blur],
            ["hold", 48, 36, 300, 0],
            ["until", f"{opacity} < 1"],
            ["evaluate", opacity],
            ["release", 348, 36],
            ["until", f"{opacity} === 1"],
            ["evaluate", "parseInt(renderer.getClearColor({ copy: (colour) => colour.getHexString() }), 16)"],
            *ask,
            ["evaluate", small],
        ]
        results = in_browser(steps, tmp_path, size=(3 * rig.width, 3 * rig.height))
        before, _, after, (amount, used, height) = results[2:6]
        assert math.dist(before, after) > 0.01, "a drag turns"
        assert 0.4 <= results[8] < 1, "a view outside of the recorded region fades, and springs back"
        behind = [results[11] >> shift & 255 for shift in (16, 8, 0)]
        assert behind == pytest.approx([255 * value for value in make_meta().background], abs=1), (
            "the stream's background"
        )
        assert height == 3 * rig.height
        assert (amount, used) == (pytest.approx(9 * 0.3), pytest.approx(9 * 0.3))
        for frame, text in zip(frames, results[12:-1], strict=True):
            picture = decoded(text, rig.width, rig.height)[::-1]
            found = psnr(drawn(playback, frame), picture)
            print(frame, found)
            assert found >= 30, frame
    whole, part, splats = results[-1]
    # Everything is sent in whole lines of 512 Gaussians, three texels for geometry and three for colours.
    assert whole == math.ceil(splats / 512) * 512 * 16 * (3 + 3)
    assert 0 < part < whole
