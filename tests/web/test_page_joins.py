"""Seeking by joins in a real browser: the right frames, also without ranges, without joins, and with damaged ones."""

from __future__ import annotations

import json

import pytest
from browser_runs import PLAYER, READY, at, needs_browser, serving, try_in_browser
from moving_scenes import moving_packets

from gsstream.packet import StreamWriter
from gsstream.player.playback import Playback
from gsstream.serve.package import package

pytestmark = needs_browser
ATTRIBUTES = ["means", "quats", "scales", "opacities", "sh0", "shN"]
#: The sum of all values of a state: one number that tells states apart.
SUM = f"""{PLAYER}.scene().then((scene) =>
  {ATTRIBUTES}.reduce((sum, name) => scene[name].reduce((s, v) => s + v, sum), 0))"""


@pytest.fixture(scope="module")
def joined(tmp_path_factory):
    """A folder with a stream of 40 frames, two segments, and joins every 5 frames; and the sums of its states."""
    folder = tmp_path_factory.mktemp("joined")
    stream = folder.parent / "joined.gss"
    with StreamWriter.open(stream) as writer:
        for packet in moving_packets(seed=5, frames=40, number=30, nodes=10, sh_rest=0, key_at=27):
            writer.append(packet)
    done = package(stream, folder, join_every=5 / 30)
    assert done.joins == 5 + 2
    with Playback(stream) as playback:
        sums = [sum(float(a.astype("f8").sum()) for _, a in playback.state_at(f).items()) for f in playback.frames]
    return folder, sums


@pytest.mark.parametrize("fault", ["none", "ranges", "absent joins", "damaged joins"])
def test_seeking_shows_the_right_frames(joined, tmp_path, fault):
    folder, sums = joined
    manifest = json.loads((folder / "stream.json").read_text())
    joins = [join["file"] for segment in manifest["segments"] for join in segment["joins"]]
    source = "stream.json"
    if fault in ("absent joins", "damaged joins"):
        text = json.dumps(manifest)
        for name in joins:
            bad = name.replace(".gsj", "-bad.gsj")
            text = text.replace(name, bad)
            data = bytearray((folder / name).read_bytes())
            data[len(data) // 2] ^= 1
            if fault == "damaged joins":
                (folder / bad).write_bytes(bytes(data))
        source = f"{fault.split()[0]}.json"
        (folder / source).write_text(text)
    order = [23, 8, 39, 26, 0, 17]
    steps = [["go", f"URL/index.html?src={source}"], READY]
    for frame in order:
        steps += [["evaluate", f"{PLAYER}.seek({frame})"], ["until", f"{PLAYER}.frame === {frame}"], ["evaluate", SUM]]
    steps += [["evaluate", f"{PLAYER}.problem"]]
    with serving(folder, **({"ranges": False} if fault == "ranges" else {})) as (url, server):
        results, _ = try_in_browser(at(url, steps), tmp_path, size=(120, 90))
        asked = [path.rsplit("/", 1)[-1] for path, _ in server.requests]
    assert results[4:-1:3] == pytest.approx([sums[frame] for frame in order], rel=1e-9)
    assert results[-1] is None
    assert any(name.endswith(".gsj") for name in asked)
    if fault == "ranges":
        assert len([name for name in asked if name.endswith(".gss")]) <= 6


def test_playing_through_needs_no_join(joined, tmp_path):
    folder, _ = joined
    steps = [["go", "URL/index.html?autoplay=1&loop=false"], ["until", f"{PLAYER}?.frame === 39"]]
    with serving(folder, ranges=False) as (url, server):
        try_in_browser(at(url, steps), tmp_path, size=(120, 90))
        asked = [path.rsplit("/", 1)[-1] for path, _ in server.requests]
    assert not [name for name in asked if name.endswith(".gsj")]
    assert len([name for name in asked if name.endswith(".gss")]) == 2, "each segment once, although sent whole"
