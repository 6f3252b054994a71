"""The page in a real browser: pictures against the Python player, playing, and servers that fail."""

from __future__ import annotations

import json
import zlib
from pathlib import Path

import numpy as np
import pytest
from browser_runs import MESSAGE, PLAYER, READY, ROOT, at, in_browser, needs_browser, serving, try_in_browser
from moving_scenes import make_meta, moving_packets
from pictures import decoded, drawn, psnr

from gsstream.cli.main import run_command
from gsstream.packet import FORMAT_VERSION, StreamWriter
from gsstream.player.playback import Playback
from gsstream.serve.package import package

pytestmark = needs_browser
SIZE = (120, 90)


def pictures(encoded: list[str], width: int, height: int) -> list[np.ndarray]:
    return [decoded(text, width, height) for text in encoded]


def test_pictures_of_a_run_are_those_of_the_python_player(tmp_path):
    source = "synthetic:frames=6&views=3&width=64&height=48"
    settings = ["--set", "first_frame.max_iterations=60", "--set", "first_frame.points=recording"]
    run = ["run", "--source", source, "--out", str(tmp_path / "run"), "--method", "s2gs-fast", *settings]
    assert run_command([*run, "--quiet", "--no-pictures"]) == 0
    stream = tmp_path / "run" / "stream.gss"
    package(stream, tmp_path / "site")
    frames = [0, 1, 2, 4, 5]
    with serving(tmp_path / "site") as (url, _), Playback(stream) as playback:
        rig = playback.cameras("test")
        steps = [["go", f"{url}/index.html"], READY, *(["picture", f, rig.width, rig.height] for f in frames)]
        got = pictures(in_browser(steps, tmp_path, size=SIZE)[2:], rig.width, rig.height)
        for frame, picture in zip(frames, got, strict=True):
            expected = drawn(playback, frame)
            assert expected.std() > 10, "a picture of nothing tests little"
            assert psnr(expected, picture) >= 45, frame


@pytest.mark.parametrize("sh_rest", [0, 3, 8, 15])
def test_every_degree_of_colour_and_every_kind_of_change_is_drawn_as_in_python(tmp_path, sh_rest):
    stream = tmp_path / "s.gss"
    with StreamWriter.open(stream) as writer:
        for packet in moving_packets(seed=9, frames=9, number=300, sh_rest=sh_rest, key_at=6):
            writer.append(packet)
    package(stream, tmp_path / "site")
    # To and fro: what a seek leaves behind in the textures would be seen.
    frames = [8, 2, 5, 6]
    rig = make_meta().test
    with serving(tmp_path / "site") as (url, _), Playback(stream) as playback:
        steps = [["go", f"{url}/index.html"], READY, *(["picture", f, rig.width, rig.height] for f in frames)]
        got = pictures(in_browser(steps, tmp_path, size=SIZE)[2:], rig.width, rig.height)
        for frame, picture in zip(frames, got, strict=True):
            assert psnr(drawn(playback, frame), picture) >= 45, frame


def test_playing_seeking_keys_and_views(site, tmp_path):
    steps = [
        ["go", "URL/index.html?autoplay=1&loop=false&speed=4"],
        ["until", f"{PLAYER}?.frame === 11 && !{PLAYER}.playing"],
        ["evaluate", f"{PLAYER}.seek(3), {ROOT}.querySelector('canvas').focus()"],
        ["until", f"{PLAYER}.frame === 3"], ["key", "."], ["until", f"{PLAYER}.frame === 4"],
        ["key", "2"], ["evaluate", f"{PLAYER}.view.id"], ["key", "1"], ["evaluate", f"{PLAYER}.view.id"],
        ["evaluate", f"{PLAYER}.view.eye"], ["drag", 60, 30, 20, 0], ["evaluate", f"{PLAYER}.view.eye"],
        ["wheel", 60, 30, -200], ["pause", 200], ["evaluate", f"{PLAYER}.view.eye"],
        ["key", "g"], ["evaluate", f"{PLAYER}.marks"],
        ["evaluate", f"{ROOT}.querySelector('.camera').options.length"],
    ]  # fmt: skip
    with serving(site) as (url, _):
        results = in_browser(at(url, steps), tmp_path, size=(200, 100))
    second, first, before, after, nearer, marks, cameras = (results[i] for i in (7, 9, 10, 12, 15, 17, 18))
    assert (second, first) == ("left", "held-out")
    assert before != after != nearer
    assert marks is True
    assert cameras == 2


def test_a_picture_that_does_not_change_is_not_drawn_again(site, tmp_path):
    """Every picture asked for the order, and every order for a picture, without an end."""
    drawn = ["evaluate", f"{PLAYER}.statistics.drawn"]
    steps = [
        ["go", "URL/index.html"], READY, ["pause", 1500], drawn, ["pause", 700], drawn,
        ["evaluate", f"{PLAYER}.look(1)"], ["pause", 1000], drawn, ["evaluate", f"{PLAYER}.seek(6)"],
        ["pause", 1000], drawn, ["evaluate", f"{PLAYER}.seek(0)"], ["pause", 1000], drawn,
        ["evaluate", f"{PLAYER}.frame"],
    ]  # fmt: skip
    with serving(site) as (url, server):
        results = in_browser(at(url, steps), tmp_path, size=SIZE)
    first, later, turned, jumped, back, frame = (results[i] for i in (3, 5, 8, 11, 14, 15))
    # One was drawn before there was any order, one for every packet that came, and two after a jump.
    assert first == later == 1
    assert later < turned <= later + 2
    assert (jumped, back, frame) == (turned + 1, turned + 2, 0)
    # The page asks for the first segment before the player is there to do so; it is loaded once all the same.
    manifest = json.loads((site / "stream.json").read_text())
    for segment in manifest["segments"]:
        assert server.requests.count((f"/{segment['file']}", None)) == 1


@pytest.mark.parametrize(
    ("name", "faults"),
    [
        ("stream.json", {}),
        ("stream.json", {"cut_after": 3000}),
        ("stream.gss", {}),
        ("stream.gss", {"ranges": False}),
        ("stream.gss", {"cut_after": 3000}),
    ],
)
def test_every_frame_is_reached_whatever_the_server_does(site, tmp_path, name, faults):
    """Ranges, none (200 for 206), and connections that break again and again."""
    steps = [
        ["go", f"URL/index.html?src={name}"],
        READY,
        ["evaluate", f"{PLAYER}.seek(11)"],
        ["until", f"{PLAYER}.frame === 11", 30],
        ["evaluate", f"{PLAYER}.seek(8)"],
        ["until", f"{PLAYER}.frame === 8", 30],
        ["evaluate", f"[{PLAYER}.first, {PLAYER}.last, {PLAYER}.problem]"],
    ]
    with serving(site, **faults) as (url, server):
        results, _ = try_in_browser(at(url, steps), tmp_path, size=SIZE)
    assert results[-1] == [0, 11, None]
    asked = [wanted for path, wanted in server.requests if path == "/stream.gss"]
    assert (name == "stream.gss") == bool(asked)


def test_a_seek_in_a_file_with_an_index_fetches_the_last_segment_first(site, tmp_path):
    steps = [
        ["go", "URL/index.html?src=stream.gss"],
        READY,
        ["evaluate", f"{PLAYER}.buffer.parts"],
    ]
    with serving(site) as (url, server):
        results = in_browser(at(url, steps), tmp_path, size=SIZE)
        ranges = [wanted for path, wanted in server.requests if path == "/stream.gss"]
    assert results[-1] == 2
    assert ranges[0] == "bytes=-12"
    assert all(wanted.startswith("bytes=") for wanted in ranges)


def test_another_rendition_shows_the_same_frame(tmp_path):
    streams = [tmp_path / "full.gss", tmp_path / "small.gss"]
    for path, number in zip(streams, (80, 20), strict=True):
        with StreamWriter.open(path) as writer:
            for packet in moving_packets(seed=3, frames=8, number=number, nodes=10, key_at=5):
                writer.append(packet)
    package(streams[0], tmp_path / "site", renditions=streams[1:])
    choose = "document.querySelector('gsstream-player').shadowRoot.querySelector('.rendition')"
    steps = [
        ["go", "URL/index.html"], READY, ["evaluate", f"{PLAYER}.seek(6)"], ["until", f"{PLAYER}.frame === 6"],
        ["evaluate", f"{PLAYER}.state.number"], ["evaluate", f"{choose}.hidden"],
        ["evaluate", f"{choose}.selectedIndex = 1, {choose}.onchange()"], ["until", f"{PLAYER}.frame === 6"],
        ["evaluate", f"{PLAYER}.state.number"], ["picture", 7, 32, 24],
    ]  # fmt: skip
    with serving(tmp_path / "site") as (url, _):
        results = in_browser(at(url, steps), tmp_path, size=SIZE)
    with Playback(streams[0]) as full, Playback(streams[1]) as small:
        assert (results[4], results[5], results[8]) == (len(full.state_at(6)), False, len(small.state_at(6)))
        expected = drawn(small, 7)
    (got,) = pictures(results[9:], 32, 24)
    assert psnr(expected, got) >= 45


def test_what_is_wrong_is_said_in_one_sentence(site, tmp_path):
    sound = (site / "stream.gss").read_bytes()
    newer = bytearray(sound)
    newer[8] += 1
    newer[12:16] = zlib.crc32(newer[:12]).to_bytes(4, "little")
    for name, data in {
        "none.gss": b"<!doctype html>",
        "empty.gss": b"",
        "newer.gss": bytes(newer),
    }.items():
        (site / name).write_bytes(data)
    manifest = json.loads((site / "stream.json").read_text())
    (site / "newer.json").write_text(json.dumps({**manifest, "format": "gsstream 99.0"}))
    (site / "other.json").write_text("[]")
    expected = {
        "absent.gss": "404",
        "absent.json": "404",
        "none.gss": "not a gsstream file",
        "empty.gss": "not a gsstream file",
        "newer.gss": "newer than this player",
        "newer.json": "99.0",
        "other.json": "no manifest",
    }
    steps = []
    for name in expected:
        said = f"{PLAYER} && {MESSAGE} !== 'Loading …' && {MESSAGE}"
        steps += [["go", f"URL/index.html?src={name}"], ["until", said]]
        steps += [["evaluate", MESSAGE]]
    with serving(site) as (url, _):
        results, _ = try_in_browser(at(url, steps), tmp_path, size=SIZE)
    for (name, words), text in zip(expected.items(), results[2::3], strict=True):
        assert words in text, name
        assert "\n" not in text


@pytest.mark.parametrize("name", ["damaged.gss", "cut.gss"])
def test_what_is_sound_is_played(site, tmp_path, name):
    sound = (site / "stream.gss").read_bytes()
    damaged = bytearray(sound)
    damaged[len(sound) // 3] ^= 255
    (site / name).write_bytes(bytes(damaged) if name == "damaged.gss" else sound[: len(sound) // 3])
    with Playback(site / name) as playback:
        frames = 0
        try:
            for frame in playback.frames:
                playback.state_at(frame)
                frames += 1
        except ValueError:
            pass
    steps = [
        ["go", f"URL/index.html?src={name}&autoplay=1&loop=false&speed=0.25"],
        ["until", f"{PLAYER}?.state && {PLAYER}.frame >= {frames - 1} && !{PLAYER}.playing", 30],
        ["evaluate", f"{PLAYER}.frame"],
        ["evaluate", f"{PLAYER}.problem !== null"],
    ]
    with serving(site) as (url, _):
        results, _ = try_in_browser(at(url, steps), tmp_path, size=SIZE)
    assert 0 < frames < 7
    # Slowly, since a page that draws late leaves frames out, and might leave out all the damaged ones.
    # Of the damaged file the second segment is sound, which is said; a file that just ends is one being written.
    assert results[-2:] == ([11, True] if name == "damaged.gss" else [frames - 1, False])


def test_a_server_that_stops_is_told_and_what_is_loaded_plays_on(site, tmp_path):
    """The second segment never comes; once the server is back, playing goes on."""
    steps = [
        # A jump gives up a segment that is not whole, and this one could not be had again.
        ["go", "URL/index.html"], READY, ["evaluate", f"{PLAYER}.seek(6)"], ["until", f"{PLAYER}.frame === 6"],
        ["evaluate", f"{PLAYER}.seek(9)"], ["until", f"{PLAYER}.problem", 30], ["evaluate", MESSAGE],
        ["evaluate", f"{PLAYER}.seek(5)"], ["until", f"{PLAYER}.frame === 5"],
        ["evaluate", "fetch('mended')"], ["evaluate", f"{PLAYER}.play()"], ["until", f"{PLAYER}.frame >= 9"],
    ]  # fmt: skip
    with serving(site, gone_after=1) as (url, _):
        results, _ = try_in_browser(at(url, steps), tmp_path, size=SIZE)
    assert "connection" in results[6]


def test_a_browser_without_webgl_says_so(site, tmp_path):
    shown = "document.querySelector('gsstream-player')?.shadowRoot"
    steps = [["go", "URL/index.html"], ["until", shown], ["evaluate", MESSAGE]]
    with serving(site) as (url, _):
        (*_, text), _ = try_in_browser(at(url, steps), tmp_path, flags=["--disable-3d-apis"], size=SIZE)
    assert "WebGL2" in text


def test_the_page_works_in_a_frame_of_another_page(site, tmp_path):
    (site / "outer.html").write_text("<!doctype html><iframe src='index.html' width=100 height=80></iframe>")
    inner = "document.querySelector('iframe')?.contentDocument?.querySelector('gsstream-player')?.player?.state"
    with serving(site) as (url, _):
        in_browser(at(url, [["go", "URL/outer.html"], ["until", inner]]), tmp_path, size=SIZE)


@pytest.mark.parametrize("name", ["field", "light", "layers", "world"])
def test_a_field_is_decoded_by_a_module_that_comes_with_it(tmp_path, name):
    """Each stored stream plays to the state of Python; what decodes fields and lights is asked for where some are."""
    stream = Path(__file__).parents[1] / "packet" / "samples" / FORMAT_VERSION / f"{name}.gss"
    package(stream, tmp_path / "site")
    with Playback(stream) as playback:
        last = playback.frames[-1]
        scene = playback.state_at(last)
    found = f"{PLAYER}.scene().then(({{ means, sh0 }}) => [...means, ...sh0])"
    seek, wait = ["evaluate", f"{PLAYER}.seek({last})"], ["until", f"{PLAYER}.frame === {last}"]
    steps = [["go", "URL/index.html"], READY, seek, wait, ["evaluate", found]]
    with serving(tmp_path / "site") as (url, server):
        results = in_browser(at(url, steps), tmp_path, size=SIZE)
        asked = {path.removeprefix("/").removesuffix(".js") for path, _ in server.requests}
    assert np.array_equal(np.float32(results[-1]), np.concatenate([scene.means.ravel(), scene.sh0.ravel()]))
    assert [part for part in ("field", "light") if f"changes/{part}" in asked] == [name] * (name in ("field", "light"))


def test_the_page_is_small(site):
    import gzip

    folder = Path(__file__).parents[2] / "gsstream" / "web"
    files = [p.relative_to(folder) for p in folder.rglob("*") if p.is_file() and "vendor" not in p.parts]
    sizes = {str(name): len(gzip.compress((site / name).read_bytes())) for name in files}
    # What only a live stream takes, a seek by a join, a stream without a package, a packet with a field or a light, a
    # headset and the statistics is loaded only there.
    names = ("live", "live-socket", "live-parts", "latency", "joins", "file", "statistics", "xr")
    later = [sizes.pop(f"{name}.js") for name in (*names, "changes/field", "changes/light")]
    assert len(sizes) > 20
    assert sum(sizes.values()) <= 60_000
    assert sum(later) <= 13_900
