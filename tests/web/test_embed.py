"""The player as a part of other people's pages, in a real browser: what it leaves to the page, and how it looks."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from browser_runs import MESSAGE, PLAYER, ROOT, at, in_browser, needs_browser, serving, try_in_browser
from moving_scenes import moving_packets

from gsstream.packet import StreamWriter
from gsstream.serve.package import package

pytestmark = needs_browser
#: A page of somebody else: text, the player, and much more text.
OUTER = """<!doctype html><meta name="viewport" content="width=device-width"><style>body { margin: 0 }</style>
<p>Text.</p><script type="module" src="element.js"></script><gsstream-player src="stream.json"></gsstream-player>
<div style="height: 3000px">More text.</div>"""
READY = ["until", f"{PLAYER}?.statistics.drawn"]


@pytest.fixture(scope="module", autouse=True)
def outer(site):
    """A page of somebody else, beside the packaged stream."""
    (site / "outer.html").write_text(OUTER)


def look(site: Path, tmp_path: Path, steps: list, **settings: object) -> list:
    """Carry out steps on a served site, whose address is URL in them."""
    with serving(site) as (url, _):
        return in_browser(at(url, steps), tmp_path, **settings)


@pytest.mark.parametrize("limits", ["", "none"])
def test_a_hand_that_leaves_the_recorded_region_comes_back_unless_it_is_free(site, tmp_path, limits):
    opacity = f"Number({ROOT}.querySelector('canvas').style.opacity || 1)"
    state = f"[{opacity}, document.querySelector('gsstream-player').controls.outside, {PLAYER}.view.eye.join()]"
    steps = [
        ["go", f"URL/index.html?limits={limits}"], READY, ["evaluate", state],
        ["hold", 300, 100, 400, 0], ["pause", 500], ["evaluate", state],
        ["release", 700, 100], ["pause", 200], ["until", f"{opacity} === 1"], ["evaluate", state],
    ]  # fmt: skip
    results = look(site, tmp_path, steps)
    first, held, left = results[2], results[5], results[9]
    assert first[:2] == [1, 0]
    assert first[2] != held[2]
    if limits:
        assert (held[:2], left) == ([1, 0], held), "nothing fades, and the view stays where the hand left it"
    else:
        assert held[1] == pytest.approx(1), "the hand drags as far as it may"
        assert held[0] == pytest.approx(0.4), "it fades, and never goes dark"
        assert left[1] == pytest.approx(0, abs=1e-9)
        assert left[2] != held[2]


#: Every control that is shown: its name; where it lies in the player: left, top, right, bottom; the player's size.
CONTROLS = f"""
[...{ROOT}.querySelectorAll('button, select, input')].filter((part) => part.checkVisibility()).map((part) => {{
  const box = part.getBoundingClientRect(), host = document.querySelector('gsstream-player').getBoundingClientRect();
  return [part.className.split(' ')[0], box.left - host.left, box.top - host.top, box.right - host.left,
    box.bottom - host.top, host.width, host.height, part.scrollWidth - part.clientWidth];
}})"""


@pytest.mark.parametrize(
    ("page", "size", "wide"),
    [
        ("outer.html", (280, 600), False),
        ("outer.html", (320, 600), False),
        ("index.html", (390, 844), False),
        ("outer.html", (640, 700), False),
        ("index.html", (1099, 500), False),
        ("index.html", (1100, 500), True),
        ("index.html", (1920, 1080), True),
        ("index.html", (3840, 400), True),
    ],
)
def test_the_bar_is_one_line_of_large_targets_at_every_width(site, tmp_path, page, size, wide):
    steps = [
        ["go", f"URL/{page}"],
        READY,
        ["evaluate", CONTROLS],
        ["evaluate", f"{ROOT}.querySelector('.more').click()"],
        ["evaluate", CONTROLS],
    ]
    _, _, closed, _, opened = look(site, tmp_path, steps, size=size)
    inside = ["speed", "loop", "marks", "statistics", "full"]
    bar = ["play", "seek", "camera"]
    assert [name for name, *_ in closed] == (bar + inside if wide else [*bar, "more"])
    assert [name for name, *_ in opened] == (bar + inside if wide else [*bar, *inside, "more"])
    assert len({top for name, _, top, *_ in opened if name in (*bar, "more")}) == 1, "one line"
    for name, left, top, right, bottom, width, height, cut in opened:
        assert left >= 0, name
        assert top >= 0, name
        assert right <= width, name
        assert bottom <= height, name
        assert right - left >= 44, name
        assert bottom - top >= 44, name
        assert cut <= 0, f"{name} is cut off"
    boxes = [box[1:5] for box in opened if box[0] != "speed"]  # the label of the speed is written over its list
    for i, (left, top, right, bottom) in enumerate(boxes):
        for other in boxes[:i]:
            apart = right <= other[0] or other[2] <= left or bottom <= other[1] or other[3] <= top
            assert apart, "two targets overlap"


def test_the_wheel_scrolls_the_page_until_the_player_is_clicked(site, tmp_path):
    state = ["evaluate", f"[scrollY, Math.hypot(...{PLAYER}.view.eye)]"]
    wheel = [["wheel", 200, 150, 60], ["pause", 400], state]
    steps = [
        ["go", "URL/outer.html"], READY, state, *wheel,
        ["drag", 200, 150, 0, 0], ["evaluate", "scrollTo(0, 0)"], ["pause", 200], *wheel,
        ["evaluate", "scrollTo(0, 100)"], ["drag", 200, 395, 0, 0], ["pause", 200], *wheel,
    ]  # fmt: skip
    results = look(site, tmp_path, steps, size=(600, 400))
    first, passed, taken, elsewhere = (results[i] for i in (2, 5, 11, 17))
    assert passed == [60, first[1]]
    assert taken[0] == 0
    assert taken[1] != first[1]
    assert elsewhere == [160, taken[1]]


def finger(x: float, y: float, dx: float = 0, dy: float = 0) -> list:
    """Steps in which one finger touches the page, moves, and is lifted."""

    def touch(kind: str, *points: dict[str, float]) -> list:
        return ["send", "Input.dispatchTouchEvent", {"type": kind, "touchPoints": points}]

    steps = [touch("touchStart", {"x": x, "y": y})]
    for part in [i / 8 for i in range(1, 9) if dx or dy]:
        steps += [touch("touchMove", {"x": x + dx * part, "y": y + dy * part}), ["pause", 16]]
    return [*steps, touch("touchEnd"), ["pause", 500]]


def test_a_finger_scrolls_the_page_until_the_player_is_tapped(site, tmp_path):
    """Regression: a finger that scrolled the page turned the scene by what it moved until the browser knew."""
    still = ["until", "!document.querySelector('gsstream-player').controls.outside"]
    state = ["evaluate", f"[scrollY, {PLAYER}.view.eye.join()]"]
    steps = [
        ["send", "Emulation.setTouchEmulationEnabled", {"enabled": True}], ["go", "URL/outer.html"], READY, state,
        *finger(200, 250, dy=-150), state, ["evaluate", "scrollTo(0, 0)"], *finger(200, 150, dx=60), still, state,
        *finger(200, 150), state, *finger(200, 250, dy=-60), still, state,
    ]  # fmt: skip
    results = look(site, tmp_path, steps, size=(600, 400))
    first, passed, turned, tapped, taken = (found for found in results if isinstance(found, list))
    assert passed[0] > 100
    assert passed[1] == first[1]
    assert turned[0] == 0
    assert turned[1] != first[1], "a finger across turns, because no page scrolls that way"
    assert tapped == turned
    assert taken[0] == 0
    assert taken[1] != tapped[1]


@pytest.mark.parametrize(
    ("page", "poster"),
    [("index.html", "poster.jpg"), ("outer.html", "poster.jpg"), ("index.html?poster=mine.jpg", "mine.jpg")],
)
def test_the_poster_is_shown_until_the_first_picture(site, tmp_path, page, poster):
    shutil.copy(site / "poster.jpg", site / "mine.jpg")
    image = f"{ROOT}.querySelector('.poster')"
    bar = f"{ROOT}.querySelector('.bar').checkVisibility()"
    state = f"[{image}.checkVisibility() && {image}.src.split('/').pop(), {bar}, {MESSAGE}]"
    steps = [
        ["go", f"URL/{page}"],
        ["until", f"{ROOT}?.querySelector('.poster').naturalWidth"],
        ["pause", 200],
        ["evaluate", state],
        ["evaluate", "fetch('mended')"],
        READY,
        ["evaluate", state],
    ]
    with serving(site, held_after=100) as (url, _):
        results = in_browser(at(url, steps), tmp_path)
    assert results[3] == [poster, False, "Loading …"]
    assert results[-1] == [False, True, ""]


def test_the_poster_does_not_wait_for_modules(site, tmp_path):
    """Regression: it came with the first picture, because its address was known to the player alone."""
    with serving(site) as (url, server):
        steps = [
            ["send", "Network.setBlockedURLs", {"urls": ["*element.js"]}],
            ["go", f"{url}/index.html"],
            ["until", f"performance.getEntriesByName('{url}/poster.jpg').length"],
        ]
        try_in_browser(steps, tmp_path)
        asked = [path for path, _ in server.requests]
    assert "/element.js" not in asked
    assert asked.count("/poster.jpg") == 1


def test_a_page_opened_as_a_file_says_how_to_serve_it(site, tmp_path):
    steps = [
        ["go", (site / "index.html").as_uri()],
        ["until", "document.querySelector('p')"],
        ["evaluate", "document.body.innerText"],
    ]
    (*_, text), _ = try_in_browser(steps, tmp_path)
    assert f'python -m http.server --directory "{site}/"' in text
    assert "gsstream-player" not in text


def test_a_still_scene_has_no_time(tmp_path):
    stream, site = tmp_path / "still.gss", tmp_path / "site"
    with StreamWriter.open(stream) as writer:
        writer.append(moving_packets(seed=3, frames=1, number=80, nodes=20)[0])
    package(stream, site)
    steps = [
        ["go", "URL/index.html"],
        READY,
        ["evaluate", f"{ROOT}.querySelector('.more').click()"],
        ["evaluate", CONTROLS],
        ["evaluate", f"{ROOT}.querySelector('.time').checkVisibility()"],
    ]
    *_, controls, time = look(site, tmp_path, steps)
    assert [name for name, *_ in controls] == ["camera", "statistics", "full", "more"]
    assert not time


def test_on_a_page_of_its_own_the_player_takes_keys_and_the_wheel_at_once(site, tmp_path):
    steps = [
        ["go", "URL/index.html?loop=false"], READY, ["key", " "], ["until", f"{PLAYER}.frame > 0"],
        ["evaluate", f"{PLAYER}.view.eye"], ["wheel", 200, 150, 60], ["pause", 300], ["evaluate", f"{PLAYER}.view.eye"],
        ["evaluate", "[document.title, document.querySelector('h1').textContent]"],
    ]  # fmt: skip
    results = look(site, tmp_path, steps)
    assert results[4] != results[7]
    assert results[8] == [json.loads((site / "stream.json").read_text())["name"]] * 2
