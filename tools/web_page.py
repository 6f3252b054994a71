"""Measure the page in a headless Chromium: first picture and seek on a slow line, uploads, sorting, pictures.

Usage: python -m tools.web_page STREAM --out DIR [--mbit 20] [--join-every SECONDS] [--frames 5]

Packages the stream into DIR/site and plays it there; prints JSON. Times are wall times in the page, from the request of
the page on, and processor times of all the browser's processes, which other work on the machine changes less. DIR gets
the pictures of the held-out camera and views between the cameras, to be looked at.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import numpy as np
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1] / "tests" / "web"))

P = "document.querySelector('gsstream-player')?.player"
#: A pixel that is read back is drawn.
FINISH = f"(({{ gl }}) => gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4)))({P}.renderer)"
#: Milliseconds since the page was asked for, once the graphics have finished the page's own first picture.
DRAWN = f"""(async () => {{
  while (!{P}.statistics.drawn) await new Promise((resolve) => setTimeout(resolve, 5));
  {FINISH};
  return performance.now();
}})()"""
SEEK = f"""(async () => {{
  const started = performance.now(), before = {P}.buffer.received, drawn = {P}.statistics.drawn;
  {P}.seek(FRAME);
  while ({P}.frame !== FRAME || {P}.statistics.drawn === drawn) await new Promise((resolve) => setTimeout(resolve, 5));
  {FINISH};
  return [performance.now() - started, {P}.buffer.received - before];
}})()"""
STEPS = f"""(async () => {{
  const found = [];
  for (let frame = {P}.frame + 1; frame <= Math.min({P}.last, {P}.first + 8); frame += 1) {{
    const uploaded = {P}.statistics.uploaded;
    {P}.seek(frame);
    while ({P}.frame !== frame) await new Promise((resolve) => setTimeout(resolve, 5));
    const rows = new Set(({P}.state.change.moved ?? []).flatMap((part) => [...part.rows])).size;
    {P}.draw();
    await new Promise((resolve) => setTimeout(resolve, 30));
    found.push([rows, {P}.statistics.uploaded - uploaded, {P}.renderer.sorter.milliseconds]);
  }}
  return found;
}})()"""
TURN = """import('./camera.js').then(({{ orbited }}) => {{
  {p}.look(0);
  {p}.view = orbited({p}.view, {p}.pivot, {yaw}, {tip});
  {p}.moved();
}})"""


def main() -> int:
    """Measure and print JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("stream")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--mbit", type=float, default=20.0)
    parser.add_argument("--join-every", type=float, default=10.0)
    parser.add_argument("--frames", type=int, default=5, help="pictures that are compared")
    parser.add_argument("--size", type=int, nargs=2, default=(320, 180), help="of the page; software graphics are slow")
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    print(json.dumps(measure(given), indent=1))
    return 0


def measure(given: argparse.Namespace) -> dict[str, object]:
    """Play the stream in the page and return what was found."""
    from browser_runs import in_browser, serving
    from pictures import decoded, drawn, psnr

    from gsstream.player.playback import Playback
    from gsstream.serve.package import package

    done = package(given.stream, given.out / "site", join_every=given.join_every)
    with Playback(given.stream) as playback, serving(given.out / "site") as (url, _):
        rig, frames = playback.cameras("test"), playback.frames
        last = frames[-1]
        shown = [frames[i] for i in np.linspace(0, len(frames) - 1, given.frames).astype(int)]
        ready = ["until", f"{P}?.state && {P}._target === null", 120]
        # A viewer's browser runs already: its own start, and the graphics' first picture, are not the page's.
        running = [["go", "about:blank"], ["pause", 3000]]
        steps = [
            *running, ["throttle", given.mbit * 1e6 / 8],
            ["processor"], ["go", f"{url}/index.html"], ready, ["evaluate", DRAWN],
            ["processor"], ["evaluate", f"{P}.buffer.received"], ["pause", 2000],
            ["processor"], ["evaluate", SEEK.replace("FRAME", str(last))], ["processor"],
            ["evaluate", SEEK.replace("FRAME", str(frames[0]))], ["processor"], ["evaluate", STEPS],
            *(["picture", frame, rig.width, rig.height] for frame in shown),
        ]  # fmt: skip
        for name, yaw, tip in (("left", 0.35, 0.0), ("right", -0.35, 0.1), ("above", 0.1, -0.25)):
            steps += [["evaluate", f"{P}.canvas.parentNode.host._fit()"]]
            steps += [["evaluate", TURN.format(p=P.replace("?.", "."), yaw=yaw, tip=tip)], ["pause", 3000]]
            steps += [["screenshot", str(given.out / f"orbit-{name}.png")]]
        results = in_browser(steps, given.out, size=tuple(given.size))[len(running) :]
        psnrs = []
        for frame, text in zip(shown, results[14 : 14 + len(shown)], strict=True):
            ours, theirs = drawn(playback, frame), decoded(text, rig.width, rig.height)
            Image.fromarray(np.concatenate([ours, theirs])).save(given.out / f"frame-{frame}.png")
            psnrs.append(round(psnr(ours, theirs), 2))
    uploads = results[13]
    return {
        "join_bytes": done.join_bytes, "first_picture_ms": results[4], "first_bytes": results[6],
        "first_picture_processor_ms": results[5] - results[1], "seek_last": results[9], "seek_first": results[11],
        "seek_processor_ms": [results[10] - results[8], results[12] - results[10]],
        "rows_uploaded_bytes_sort_ms": uploads,
        "frames": shown, "psnr": psnrs,
    }  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
