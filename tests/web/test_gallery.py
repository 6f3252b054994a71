"""The page with several streams: what it says of each are the bytes of its files, and both play in a browser."""

from __future__ import annotations

import json
import re

from browser_runs import in_browser, needs_browser, serving
from moving_scenes import moving_packets

from gsstream.packet import StreamWriter
from tools.gallery import build


def built(tmp_path):
    runs = []
    for seed, name in ((1, "one"), (2, 'two "<b>"')):
        folder = tmp_path / name
        folder.mkdir()
        with StreamWriter.open(folder / "stream.gss") as writer:
            for packet in moving_packets(seed=seed, frames=6, number=60, key_at=99):
                writer.append(packet)
        runs.append(folder)
    return build(runs, tmp_path / "gallery")


def test_bytes_are_those_of_the_files(tmp_path):
    page = built(tmp_path)
    text = page.read_text()
    first = page.parent / "1-one"
    (segment,) = json.loads((first / "stream.json").read_text())["segments"]
    (file,) = (first / "segments").glob("*.gss")
    key, later = segment["key_bytes"], (file.stat().st_size - segment["key_bytes"]) / 5
    said = re.findall(r"<dd>([\d.]+) KB(?:, ([\d.]+) Mbit/s)?</dd>", text)
    assert said[0] == (f"{key / 1000:.0f}", "")
    assert said[1] == (f"{later / 1000:.1f}", f"{later * 8 * 30 / 1e6:.2f}")
    assert "two &quot;&lt;b&gt;&quot;" in text
    assert "<b>" not in text


@needs_browser
def test_both_play_and_times_are_measured(tmp_path):
    page = built(tmp_path)
    both = "[...document.querySelectorAll('dd[class]')]"
    steps = [
        ["until", f"{both}.length && {both}.every((one) => one.textContent !== '-')"],
        ["evaluate", f"{both}.map((one) => one.textContent)"],
    ]
    with serving(page.parent) as (url, _):
        results = in_browser([["go", f"{url}/index.html"], *steps], tmp_path, size=(1200, 700))
    assert [bool(re.match(r"\d+\.\d+ m?s", text)) for text in results[-1]] == [True] * 4
