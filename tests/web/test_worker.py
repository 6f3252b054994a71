"""Decoding beside the page's thread: that it is done there, and what a page does that may have no worker."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from browser_runs import (
    MESSAGE,
    PLAYER,
    READY,
    ROOT,
    WITHOUT_WORKERS,
    at,
    in_browser,
    needs_browser,
    serving,
    try_in_browser,
)
from pictures import decoded, drawn, psnr

from gsstream.player.playback import Playback

pytestmark = needs_browser
#: Modules that the page itself has loaded; those of workers are not among them.
MODULES = "performance.getEntriesByType('resource').map(({ name }) => name.split('/').pop())"
#: A page of somebody else; POLICY stands in its head, PLACE is where the player lies.
OUTER = """<!doctype html>POLICY<script type="module" src="PLACE/element.js"></script>
<gsstream-player src="PLACE/stream.json" style="width: 200px"></gsstream-player>"""
POLICIES = {
    "none": "",
    "no workers": "<meta http-equiv='Content-Security-Policy' content=\"worker-src 'none'\">",
    "no blobs": "<meta http-equiv='Content-Security-Policy' content=\"worker-src 'self'\">",
}
#: A picture of frame 9 as text, and whether a worker decodes.
LOOK = [["picture", 9, 32, 24], ["evaluate", f"Boolean({PLAYER}.link.worker)"], ["evaluate", MODULES]]
#: Whether a page plays, and what it says in the place of a player or in it; ends when it does one of the two.
SAID = f"(document.querySelector('.none')?.textContent ?? {MESSAGE})"
PLAYS_OR_TELLS = f"{PLAYER}?.state || !['', 'Loading …'].includes({SAID})"
FOUND = f"[Boolean({PLAYER}?.state), {SAID}]"


def check(results: list, site, *, worker: bool) -> None:
    picture, found, modules = results[-3:]
    with Playback(site / "stream.gss") as playback:
        assert psnr(drawn(playback, 9), decoded(picture, 32, 24)) >= 45
    assert found is worker
    assert ("decode.js" in modules) is not worker
    assert "renderer.js" in modules


@pytest.mark.parametrize("worker", [True, False])
def test_nothing_of_a_packet_comes_to_the_page(site, tmp_path, worker):
    steps = [*([] if worker else [WITHOUT_WORKERS]), ["go", "URL/index.html"], READY, *LOOK]
    with serving(site) as (url, _):
        results = in_browser(at(url, steps), tmp_path, size=(120, 90))
    check(results, site, worker=worker)


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize("elsewhere", [False, True])
def test_other_peoples_pages_play_whatever_they_allow(site, tmp_path, policy, elsewhere):
    """The player may lie on another origin, whose modules are no workers of the page; a policy may forbid workers."""
    worker = policy == "none" or (policy == "no blobs" and not elsewhere)
    name = f"outer-{policy.replace(' ', '-')}-{elsewhere}.html"
    with serving(site) as (url, _), serving(site, cors=True) as (other, _):
        text = OUTER.replace("POLICY", POLICIES[policy]).replace("PLACE", other if elsewhere else url)
        (site / name).write_text(text)
        results, _ = try_in_browser([["go", f"{url}/{name}"], READY, *LOOK], tmp_path)
    check(results, site, worker=worker)


def modules_of(url: str, server, folder: Path) -> list[str]:
    """The modules that a page and its workers ask for until the first picture is there."""
    in_browser(at(url, [["go", "URL/index.html"], READY]), folder, size=(120, 90))
    return sorted({path.rpartition("/")[2] for path, _ in server.requests if path.endswith(".js")})


@pytest.mark.parametrize("requests", [1, 99])
def test_a_module_that_does_not_come_is_done_without_or_told(site, tmp_path, requests):
    """Each module in turn: a worker that lacks it is replaced by the page's thread, a page that lacks it says so."""
    with serving(site, lost=["", 0]) as (url, server):
        names = modules_of(url, server, tmp_path)
        assert len(names) > 30
        steps = []
        for name in names:
            lose = f"fetch('/lost/{name}/{requests}').then(() => 0)"
            steps += [["evaluate", lose], ["go", "URL/index.html"], ["until", PLAYS_OR_TELLS], ["evaluate", FOUND]]
        results, _ = try_in_browser(at(url, [["go", "URL/index.html"], READY, *steps]), tmp_path, size=(120, 90))
    found = dict(zip(names, results[5::4], strict=True))
    for name, (plays, told) in found.items():
        assert plays or told.endswith("could not be loaded. Load the page again."), (name, told)
    if requests == 1:
        # What its worker alone has asked for the page gets itself; of its own modules a browser may not ask again.
        text = " ".join(re.findall(r'^const M\w+ = "(.*)";', (site / "stream-worker.js").read_text(), re.MULTILINE))
        early = re.findall(r'modulepreload" href="(.+?)"', (site / "index.html").read_text())
        workers = {f"{name.rpartition('/')[2]}.js" for name in text.split()} - set(early)
        assert len(workers) > 15
        assert {name for name in workers if not found[name][0]} == set()
    else:
        # Workers are done without, and what decodes a light until there is one; everything else is needed.
        without = {"sort-worker.js", "stream-worker.js", "light.js"}
        assert {name for name, (plays, _) in found.items() if plays} == without


def test_a_stream_whose_next_packet_needs_a_module_that_does_not_come_says_so(site, tmp_path):
    steps = [["go", "URL/index.html"], READY, ["evaluate", f"void {PLAYER}.seek(11)"]]
    steps += [["until", f"{MESSAGE}.length > 9", 20], ["evaluate", MESSAGE]]
    with serving(site, lost=["light.js", 99]) as (url, _):
        *_, told = in_browser(at(url, steps), tmp_path)
    assert "light.js" in told


def test_a_part_that_only_some_ask_for_is_told_where_it_does_not_come(site, tmp_path):
    """Also to whoever asks before the first picture is drawn, which takes away what was said of loading."""
    click, told = f"{ROOT}.querySelector('.statistics').click()", f"{MESSAGE}.startsWith('A part of the player')"
    drawn = f"{PLAYER}.dispatchEvent(new Event('drawn'))"
    steps = [["go", "URL/index.html"], READY, ["evaluate", click], ["until", told], ["evaluate", drawn]]
    with serving(site, lost=["statistics.js", 99]) as (url, _):
        *_, still = in_browser(at(url, [*steps, ["evaluate", told]]), tmp_path)
    assert still


def test_a_manifest_that_is_not_answered_is_asked_for_again(site, tmp_path):
    """The page asks for the manifest before its modules are there; here it waits a tenth of a second for it."""
    soon = "{ const { timeout } = AbortSignal; AbortSignal.timeout = () => timeout.call(AbortSignal, 100); }"
    sooner = ["send", "Page.addScriptToEvaluateOnNewDocument", {"source": soon}]
    with serving(site, silent="stream.json") as (url, server):
        in_browser(at(url, [sooner, ["go", "URL/index.html"], READY]), tmp_path)
        assert [path for path, _ in server.requests].count("/stream.json") == 2


def test_the_newest_of_many_seeks_wins(site, tmp_path):
    """Seeks come faster than frames; each is answered by the right picture or by none."""
    seeks = "; ".join(f"{PLAYER}.seek({frame})" for frame in (11, 3, 0, 7, 2, 10, 5))
    shown = f"window.shown = []; {PLAYER}.addEventListener('frame', () => shown.push({PLAYER}.frame)); {seeks}"
    steps = [
        ["go", "URL/index.html"],
        READY,
        ["evaluate", shown],
        ["until", f"{PLAYER}._target === null"],
        ["evaluate", f"[{PLAYER}.frame, shown]"],
        ["picture", 5, 32, 24],
        ["picture", 6, 32, 24],
    ]
    with serving(site) as (url, _), Playback(site / "stream.gss") as playback:
        *_, (frame, seen), five, six = in_browser(at(url, steps), tmp_path, size=(120, 90))
        assert (frame, seen[-1]) == (5, 5)
        for number, text in ((5, five), (6, six)):
            assert psnr(drawn(playback, number), decoded(text, 32, 24)) >= 45


@pytest.mark.parametrize("playing", [False, True])
def test_graphics_that_forget_everything_get_it_again(site, tmp_path, playing):
    """A context is lost, frames go by, and it comes back: the pictures are those of before."""
    extension = f"(window.loss ??= {PLAYER}.renderer.gl.getExtension('WEBGL_lose_context'))"
    steps = [
        ["go", "URL/index.html?speed=4"], READY, ["picture", 3, 32, 24],
        ["evaluate", f"{PLAYER}.{'play' if playing else 'pause'}(), {extension}.loseContext()"], ["pause", 400],
        ["evaluate", "loss.restoreContext()"], ["pause", 300], ["evaluate", f"{PLAYER}.pause()"],
        ["picture", 3, 32, 24], ["picture", 8, 32, 24],
    ]  # fmt: skip
    with serving(site) as (url, _), Playback(site / "stream.gss") as playback:
        results = in_browser(at(url, steps), tmp_path, size=(120, 90))
        before, again, later = (decoded(results[i], 32, 24) for i in (2, 8, 9))
        assert np.array_equal(before, again)
        assert psnr(drawn(playback, 8), later) >= 45
