"""A page that shows streams side by side: static files, for any web server.

Usage: python -m tools.gallery RUN [RUN ...] --out DIR

Each RUN, a run folder or a stream, becomes a package in a folder of its own (see docs/howto/web.md). What its files
say is written beside the player: frames, Gaussians, bytes. The time to the first picture and that of decoding depend on
who looks and from where, so the page measures them there.
"""

from __future__ import annotations

import argparse
import html
import json
import os
from pathlib import Path

from gsstream.serve.package import package

PAGE = """<!doctype html>
<html lang="en">
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>Streams of 3D Gaussians</title>
<link rel="icon" href="data:,">
<style>
  body { margin: 0; padding: 24px; background: #111; color: #eee; font: 16px/1.4 system-ui, sans-serif; }
  main { display: grid; gap: 24px; grid-template-columns: repeat(auto-fit, minmax(min(100%, 520px), 1fr)); }
  figure { margin: 0; }
  dl { display: grid; grid-template-columns: auto 1fr; gap: 2px 12px; margin: 8px 0; }
  dd { margin: 0; font-variant-numeric: tabular-nums; }
</style>
<h1>Streams of 3D Gaussians</h1>
<p>Drag to look around. Times are those of this browser and this connection.</p>
<main>
FIGURES
</main>
<script type="module">
  const begun = performance.now();
  for (const figure of document.querySelectorAll("figure")) {
    const element = figure.querySelector("gsstream-player");
    const say = (name, text) => { figure.querySelector(`.${name}`).textContent = text; };
    const decoding = [];
    customElements.whenDefined("gsstream-player").then(() => {
      const { player } = element;
      player.addEventListener("drawn", () => say("first", `${((performance.now() - begun) / 1000).toFixed(2)} s`));
      player.addEventListener("frame", () => {
        if (player.statistics.key) return;
        decoding.push(player.statistics.decode);
        decoding.splice(0, decoding.length - 60);
        const middle = [...decoding].sort((a, b) => a - b)[decoding.length >> 1];
        say("decode", `${middle.toFixed(1)} ms a frame, beside the page's work`);
      });
    });
  }
  await import("./FIRST/element.js");
</script>
</html>
"""
FIGURE = """<figure>
<gsstream-player src="{folder}/stream.json" autoplay></gsstream-player>
<figcaption>
<h2>{name}</h2>
<dl>
<dt>recording</dt><dd>{frames} frames, {fps:g} a second, {gaussians:,} Gaussians at first</dd>
<dt>first frame</dt><dd>{key:.0f} KB</dd>
<dt>later frames</dt><dd>{later:.1f} KB, {rate:.2f} Mbit/s</dd>
<dt>first picture</dt><dd class="first">-</dd>
<dt>decoding</dt><dd class="decode">-</dd>
</dl>
</figcaption>
</figure>"""


def build(runs: list[Path], out: Path) -> Path:
    """Package the streams below ``out`` and write ``out/index.html``, which is returned."""
    folders = [f"{i}-{run.name if run.is_dir() else run.stem}" for i, run in enumerate(runs, 1)]
    figures = []
    for run, folder in zip(runs, folders, strict=True):
        package(run / "stream.gss" if run.is_dir() else run, out / folder)
        figures.append(figure_of(out / folder))
    page = out / "index.html"
    page.write_text(PAGE.replace("FIGURES", "\n".join(figures)).replace("FIRST", folders[0]), encoding="utf-8")
    return page


def figure_of(folder: Path) -> str:
    """What is said of a package beside its player."""
    manifest = json.loads((folder / "stream.json").read_text(encoding="utf-8"))
    segments = manifest["segments"]
    rest = sum(segment["bytes"] - segment["key_bytes"] for segment in segments)
    later = rest / max(1, manifest["frames"] - len(segments)) / 1000
    facts = {name: manifest[name] for name in ("frames", "fps", "gaussians")}
    return FIGURE.format(
        folder=html.escape(folder.name),
        name=html.escape(manifest["name"]),
        key=segments[0]["key_bytes"] / 1000,
        later=later,
        rate=later * 8 * manifest["fps"] / 1000,
        **facts,
    )


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="+", type=Path, help="run folders, or streams")
    parser.add_argument("--out", type=Path, required=True, help="folder of the page")
    given = parser.parse_args()
    page = build(given.runs, given.out)
    print(f"{page}; look at it: python -m http.server --directory {os.fspath(given.out)} --bind 127.0.0.1 8000")


if __name__ == "__main__":
    main()
