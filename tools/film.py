"""The film at the head of the README: a minute from the demo, the player and the terminal, as an animated WebP.

Usage: python -m tools.film --out FILE

Encodes the recording that ships with gsstream, and shows what it prints, the decoded stream from a camera that moves,
a camera that took no part in training beside what it recorded, the bytes of every frame, and the page of the player
where node and a Chromium are installed. Every line and every picture is that of this run.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from matplotlib import font_manager
from PIL import Image, ImageDraw, ImageFont

from gsstream.core.shapes import FloatArray
from gsstream.encode import open_recording
from gsstream.play import Playback, camera_path, render, to_bytes

SIZE = (640, 400)
PICTURE = (480, 360)
RUN = "gsstream run --method s2gs-edge --source demo --out runs/demo"
OPEN = "gsstream open runs/demo"
DARK, TEXT, DIM, ORANGE = (17, 17, 17), (230, 230, 230), (140, 140, 140), (255, 140, 0)
#: Pixels between two lines of the terminal; milliseconds of two keys.
LINE, KEYS = 19, 120
PROGRAM = str(Path(sys.executable).with_name("gsstream"))
#: Lines come as they are printed; the page is opened here, and not by the browser of whoever makes the film.
ENVIRONMENT = {**os.environ, "BROWSER": "true", "PYTHONUNBUFFERED": "1"}
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
#: Steps in a browser are carried out by what the tests of the page use, in node.
STEPS = Path(__file__).parents[1] / "tests" / "web" / "scenario.mjs"
READY = "document.querySelector('gsstream-player')?.player?.state"


class Shot(NamedTuple):
    """One picture of the film, of ``SIZE`` pixels, and how long it stays, milliseconds."""

    image: Image.Image
    stays: int


class Line(NamedTuple):
    """A line that a program printed, and when, seconds after its start."""

    at: float
    text: str


def record(command: Sequence[str], folder: Path) -> list[Line]:
    """Run a command in a folder and return its lines. Raises RuntimeError, with them, when it fails."""
    begun = time.monotonic()
    with subprocess.Popen(
        command, cwd=folder, env=ENVIRONMENT, text=True, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
    ) as process:
        lines = [Line(time.monotonic() - begun, text.rstrip()) for text in process.stdout or ()]
    if process.returncode:
        raise RuntimeError("\n".join([f"{' '.join(command)} ended with {process.returncode}:", *(t for _, t in lines)]))
    return lines


def terminal(command: str, lines: Sequence[Line], speed: float = 1.0) -> Iterator[Shot]:
    """A command as it is typed, then its lines, ``speed`` times as fast as they came."""
    for typed in range(0, len(command) + 1, 2):
        yield Shot(_screen([f"$ {command[:typed]}_"]), KEYS)
    note, shown, before = "" if speed == 1 else f"{speed:.0f} times as fast as it ran", [f"$ {command}"], 0.0
    for at, text in lines:
        yield Shot(_screen(shown, note), max(1, round((at - before) * 1000 / speed)))
        shown, before = [*shown, text], at
    yield Shot(_screen(shown, note), 3000)


def moving(stream: Playback, number: int) -> Iterator[Shot]:
    """``number`` pictures of the stream, again and again from its start, from a camera on an orbit."""
    # At the recording's size: in larger pictures, Gaussians that no camera told apart become needles.
    path = camera_path("orbit", stream.cameras("train"), number)
    for view in range(number):
        frame = stream.frames[view % len(stream)]
        image = render(stream.state_at(frame), path, view, stream.meta.background)
        yield Shot(_beside(image, stream, frame), round(1000 / stream.meta.fps))


def compared(stream: Playback, recorded: FloatArray) -> Iterator[Shot]:
    """The first frame of the first test camera, [H, W, 3] in [0, 1], beside the decoded one."""
    width = (SIZE[0] - 36) // 2
    height = width * recorded.shape[0] // recorded.shape[1]
    rig = stream.cameras("test")
    decoded = render(stream.state_at(stream.frames[0]), rig, 0, stream.meta.background)
    image, draw = _empty()
    for left, title, picture in ((12, "recorded", recorded), (24 + width, "decoded", decoded)):
        image.paste(Image.fromarray(to_bytes(picture)).resize((width, height)), (left, 60))
        draw.text((left, 34), title, TEXT, _font(16))
    draw.text((12, 76 + height), "The first frame of a camera that took no part in training.", TEXT, _font(14))
    yield Shot(image, 6000)


def sizes(stream: Playback) -> Iterator[Shot]:
    """Bytes of every frame, one bar after the other."""
    size = [stream.entry(frame).size for frame in stream.frames]
    wide, per = (SIZE[0] - 24) // len(size), 260 / max(size[1:], default=1)
    image, draw = _empty()
    draw.text((12, 20), f"Frame {stream.frames[0]}: {size[0] / 1000:.1f} KB. Then, KB a frame:", TEXT, _font(16))
    for place, later in enumerate(size[1:], 1):
        left, top = 12 + (place - 1) * wide, round(360 - later * per)
        draw.rectangle((left, top, left + wide - 6, 360), ORANGE)
        draw.text((left, top - 20), f"{later / 1000:.1f}", TEXT, _font(14))
        draw.text((left, 366), f"{stream.frames[place]}", DIM, _font(14))
        yield Shot(image.copy(), 300)
    yield Shot(image, 3000)


def page(run: Path, browser: str, pictures: int = 12) -> Iterator[Shot]:
    """``gsstream open``, and what a browser shows while somebody drags."""
    seen, plan, results = [run / f"page-{i}.png" for i in range(pictures)], run / "plan.json", run / "results.json"
    with subprocess.Popen([PROGRAM, "open", run], env=ENVIRONMENT, text=True, stdout=subprocess.PIPE) as server:
        try:
            said = server.stdout.readline() if server.stdout else ""
            steps: list[list[object]] = [["go", re.findall(r"http://\S+", said)[0]], ["until", READY], ["pause", 1000]]
            for number, shot in enumerate(seen):
                steps += [["screenshot", str(shot)], ["drag", 320, 200, -30 if number < pictures / 2 else 30, 0]]
            plan.write_text(json.dumps({"width": SIZE[0], "height": SIZE[1], "flags": [], "steps": steps}))
            subprocess.run(["node", STEPS, browser, plan, results], timeout=300, check=True)
        finally:
            server.terminate()
    yield from terminal(OPEN, [Line(0.5, said.strip().replace(str(run), "runs/demo"))])
    for shot in seen:
        with Image.open(shot) as image:
            yield Shot(image.convert("RGB"), 600)


def write(shots: Sequence[Shot], out: Path, quality: int = 45) -> None:
    """Write an animated WebP that begins again at its end."""
    images, stay = zip(*shots, strict=True)
    options = {"duration": list(stay), "loop": 0, "quality": quality, "method": 6, "allow_mixed": True}
    images[0].save(out, save_all=True, append_images=images[1:], **options)


def _screen(lines: Sequence[str], note: str = "") -> Image.Image:
    """The last lines of a terminal; what is too long for it is cut."""
    image, draw = _empty()
    room, columns = (SIZE[1] - 40) // LINE, int((SIZE[0] - 24) / _font(14).getlength("m"))
    for row, text in enumerate(lines[-room:]):
        cut = text if len(text) <= columns else text[: columns - 1] + "…"
        draw.text((12, 10 + row * LINE), cut, TEXT, _font(14))
    draw.text((SIZE[0] - 12, SIZE[1] - 8), note, DIM, _font(12), anchor="rs")
    return image


def _beside(picture: FloatArray, stream: Playback, frame: int) -> Image.Image:
    """A picture of the stream, and beside it which frame that is and what it costs."""
    image, draw = _empty()
    image.paste(Image.fromarray(to_bytes(picture)).resize(PICTURE), (12, 20))
    said = ["decoded,", "from a camera", "that moves", "", f"frame {frame}"]
    said += [f"{stream.entry(frame).size / 1000:.1f} KB", "", f"{len(stream.state_at(frame)):,}", "Gaussians"]
    for row, text in enumerate(said):
        draw.text((24 + PICTURE[0], 20 + row * 20), text, TEXT, _font(13))
    return image


def _empty() -> tuple[Image.Image, ImageDraw.ImageDraw]:
    image = Image.new("RGB", SIZE, DARK)
    return image, ImageDraw.Draw(image)


def _font(size: int) -> ImageFont.FreeTypeFont:
    return ImageFont.truetype(font_manager.findfont("DejaVu Sans Mono"), size)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="the film, .webp")
    out: Path = parser.parse_args().out
    with tempfile.TemporaryDirectory() as folder:
        lines = record([PROGRAM, *RUN.split()[1:]], Path(folder))
        run, browser = Path(folder) / "runs" / "demo", next(filter(None, map(shutil.which, BROWSERS)), None)
        with Playback(run / "stream.gss") as stream, open_recording("demo") as source:
            recorded = source.frame(stream.frames[0], "test").images[0]
            shots = [*terminal(RUN, lines, max(1, round(lines[-1].at / 11)))]
            shots += [*moving(stream, 156), *compared(stream, recorded), *sizes(stream)]
        shots += page(run, browser) if browser and shutil.which("node") else []
        write(shots, out)
    print(f"{out}: {sum(shot.stays for shot in shots) // 1000} seconds, {out.stat().st_size:,} bytes")


if __name__ == "__main__":
    main()
