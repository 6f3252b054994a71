"""The player by keyboard, for a screen reader, for whoever wants no motion; the rules of axe-core; clear messages."""

from __future__ import annotations

import json
import os
import shutil
import ssl
import subprocess
from pathlib import Path

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
from node_runs import needs_node, node

pytestmark = needs_browser
MODULES = Path(os.environ.get("GSSTREAM_NODE_MODULES", Path(__file__).parents[2] / "node_modules"))
needs_axe = pytest.mark.skipif(
    not (MODULES / "axe-core").is_dir(), reason="axe-core is missing in node_modules (npm install axe-core)"
)
FOCUS = f"{ROOT}.activeElement.className.split(' ')[0]"
BAR = f"Number(getComputedStyle({ROOT}.querySelector('.bar')).opacity)"
#: A page of somebody else, whose colours are PAGE's.
OUTER = """<!doctype html><html lang="en"><title>A page</title><style>body { margin: 0; PAGE }</style>
<main><h1>Text</h1><script type="module" src="element.js"></script>
<gsstream-player src="stream.json"></gsstream-player></main></html>"""


def press(name: str, code: str | None = None) -> list:
    """Steps of a real key, with what a browser does by itself."""
    codes = {"Tab": 9, "Escape": 27, " ": 32, "Enter": 13}
    event = {"key": name, "code": code or name, "windowsVirtualKeyCode": codes[name]}
    text = {" ": " ", "Enter": "\r"}.get(name)
    down = {**event, "type": "keyDown", **({"text": text} if text else {})}
    return [["send", "Input.dispatchKeyEvent", down], ["send", "Input.dispatchKeyEvent", {**event, "type": "keyUp"}]]


def look(site: Path, tmp_path: Path, steps: list, **settings: object) -> list:
    with serving(site) as (url, _):
        return in_browser(at(url, steps), tmp_path, **settings)


@needs_axe
@pytest.mark.parametrize("page", ["index.html", "light.html", "dark.html"])
@pytest.mark.parametrize("size", [(320, 500), (800, 600), (1920, 1080)])
def test_axe_finds_nothing(site, tmp_path, page, size):
    (site / "light.html").write_text(OUTER.replace("PAGE", "background: #fff; color: #111"))
    (site / "dark.html").write_text(OUTER.replace("PAGE", "background: #111; color: #eee"))
    shutil.copy(MODULES / "axe-core" / "axe.min.js", site)
    axe = """new Promise((resolve) => document.head.append(
      Object.assign(document.createElement("script"), { src: "axe.min.js", onload: () => resolve() })))"""
    found = "axe.run().then(({ violations }) => violations.map(({ id, nodes }) => [id, nodes[0].html]))"
    steps = [
        ["go", f"URL/{page}"], READY, ["evaluate", axe], ["evaluate", found],
        ["evaluate", f"{ROOT}.querySelector('.more').click(), {ROOT}.querySelector('.statistics').click()"],
        ["pause", 300], ["evaluate", found], ["evaluate", "axe.version"],
    ]  # fmt: skip
    results = look(site, tmp_path, steps, size=size)
    assert results[-1]
    assert results[3] == []
    assert results[6] == []


def test_the_focus_is_seen_and_shows_the_bar(site, tmp_path):
    """The bar of a playing stream goes when nothing moves, and comes with the focus."""
    steps = [
        ["go", "URL/index.html?autoplay=1"], READY, ["until", f"{BAR} === 0", 20], ["evaluate", BAR],
        *press("Tab"), ["until", f"{BAR} > 0.9", 20], ["evaluate", f"[{FOCUS}, {BAR}]"], ["pause", 4000],
        *press("Tab"), ["pause", 4000], ["evaluate", f"[{FOCUS}, {BAR}]"],
        ["evaluate", f"getComputedStyle({ROOT}.activeElement).outlineStyle"],
    ]  # fmt: skip
    results = look(site, tmp_path, steps)
    (first, seen), (second, still) = [found for found in results if isinstance(found, list)]
    assert (first, second) == ("play", "seek")
    assert (seen, still) == (pytest.approx(1, abs=0.1), 1)
    assert results[-1] == "solid"


def test_space_presses_the_button_that_has_the_focus_and_escape_closes(site, tmp_path):
    expanded = f"[{ROOT}.querySelector('.more').ariaExpanded, {PLAYER}.playing, {FOCUS}]"
    steps = [
        ["go", "URL/index.html"], ["until", f"{PLAYER}?.drew"], ["evaluate", f"{ROOT}.querySelector('.more').focus()"],
        *press(" "), ["evaluate", expanded], ["evaluate", f"{ROOT}.querySelector('.loop').focus()"],
        *press(" "), ["evaluate", f"{PLAYER}.loop"], *press("Escape"), ["evaluate", expanded],
        ["evaluate", f"{ROOT}.querySelector('canvas').focus()"], *press(" "), ["evaluate", f"{PLAYER}.playing"],
    ]  # fmt: skip
    results = look(site, tmp_path, steps)
    assert [found for found in results if isinstance(found, list | bool)] == [
        ["true", False, "more"],
        False,
        ["false", False, "more"],
        True,
    ]


@pytest.mark.parametrize("name", ["play", "loop", "marks", "statistics", "full", "more"])
def test_space_presses_every_button_and_nothing_else(site, tmp_path, name):
    """Each button says by one of these what it did; only one of them plays."""
    button = f"{ROOT}.querySelector('.{name}')"
    state = f"[{button}.ariaPressed, {button}.ariaExpanded, {button}.ariaLabel, Boolean(document.fullscreenElement)]"
    both = ["evaluate", f"[{state}, {PLAYER}.playing]"]
    steps = [
        ["go", "URL/index.html"],
        ["until", f"{PLAYER}?.drew"],
        ["evaluate", f"{ROOT}.querySelector('.more').click(), {button}.focus()"],
        both,
        *press(" "),
        ["pause", 300],
        both,
    ]
    (before, still), (after, playing) = [found for found in look(site, tmp_path, steps) if isinstance(found, list)]
    assert before != after
    assert (still, playing) == (False, name == "play")


def test_arrows_turn_plus_and_minus_zoom_comma_and_period_step(site, tmp_path):
    view = ["evaluate", f"[{PLAYER}.view.eye, Math.hypot(...{PLAYER}.view.eye), {PLAYER}.frame]"]
    still = ["until", "!document.querySelector('gsstream-player').controls.outside"]
    steps = [["go", "URL/index.html"], READY, ["evaluate", f"{ROOT}.querySelector('canvas').focus()"], view]
    for key in ("ArrowRight", "ArrowUp", "-", "+", ".", ".", ","):
        steps += [["key", key], still, ["until", f"{PLAYER}._target === null"], view]
    views = [found for found in look(site, tmp_path, steps) if isinstance(found, list)]
    start, right, up, far, near, one, two, back = views
    assert len({str(eye) for eye, *_ in (start, right, up)}) == 3
    assert far[1] > up[1] > 0
    assert near[1] == pytest.approx(up[1])
    assert [frame for *_, frame in (one, two, back)] == [1, 2, 1]


def test_a_screen_reader_is_told_names_and_states(site, tmp_path):
    press_play = ["evaluate", f"{ROOT}.querySelector('.play').click()"]
    said = f"""[{ROOT}.querySelector('.play').ariaLabel, {ROOT}.querySelector('.seek').ariaValueText,
      {ROOT}.querySelector('.said').textContent]"""
    steps = [
        ["go", "URL/index.html?loop=false"], READY, ["evaluate", said], press_play,
        ["evaluate", said], ["until", f"{PLAYER}.frame === 11"], ["until", f"!{PLAYER}.playing"], ["evaluate", said],
    ]  # fmt: skip
    stopped, playing, ended = [f for f in look(site, tmp_path, steps) if isinstance(f, list)]
    assert stopped == ["Play", "0.0 of 0.4 seconds", ""]
    assert playing[0] == "Pause"
    assert playing[2] == "Playing"
    assert ended[:2] == ["Play", "0.4 of 0.4 seconds"]


def test_who_wants_no_motion_begins_it(site, tmp_path):
    media = {"features": [{"name": "prefers-reduced-motion", "value": "reduce"}]}
    steps = [
        ["send", "Emulation.setEmulatedMedia", media],
        ["go", "URL/index.html?autoplay=1"],
        READY,
        ["pause", 500],
        ["evaluate", f"[{PLAYER}.playing, {PLAYER}.frame]"],
        ["evaluate", f"{ROOT}.querySelector('.play').click()"],
        ["until", f"{PLAYER}.frame > 0"],
    ]
    assert look(site, tmp_path, steps)[4] == [False, 0]


def test_attributes_may_change_and_what_is_not_there_is_said(site, tmp_path):
    element = "document.querySelector('gsstream-player')"
    values = {"camera": "left", "speed": "2", "loop": "false", "controls": "false", "marks": ""}
    change = "".join(f"{element}.setAttribute('{n}', '{v}');" for n, v in values.items())
    bar = f"{ROOT}.querySelector('.bar').hidden"
    second = """document.body.append(document.createElement('gsstream-player'));
      document.querySelectorAll('gsstream-player')[1].shadowRoot.querySelector('.message').textContent"""
    steps = [
        ["go", "URL/index.html?camera=nosuch"],
        READY,
        ["until", f"{PLAYER}.drew"],
        ["evaluate", MESSAGE],
        ["evaluate", f"{change}[{PLAYER}.view.id, {PLAYER}.speed, {PLAYER}.loop, {bar}, {PLAYER}.marks]"],
        ["evaluate", second],
    ]
    results = look(site, tmp_path, steps)
    assert '"nosuch"' in results[3]
    assert "held-out" in results[3]
    assert results[4] == ["left", 2, False, True, True]
    assert "src" in results[5]


CASES = {
    "absent.gss": ("404", "address"),
    "page.gss": ("/page.gss is not a gsstream file", "Name a stream.json"),
    "page.json": ("/page.json is no manifest", "Name a stream.json"),
    "damaged.gss": ("at byte", "again"),
    "OTHER/stream.gss": ("CORS", "Access-Control-Allow-Origin"),
    "OTHER/stream.json": ("CORS", "Access-Control-Allow-Origin"),
    "http://127.0.0.1:9/stream.gss": ("no server", "address"),
}


@pytest.mark.parametrize("name", CASES)
def test_messages_name_the_cause_and_what_to_do(site, tmp_path, name):
    (site / "page.gss").write_text("<!doctype html><p>Not here.</p>")
    (site / "page.json").write_text("<!doctype html><p>Not here.</p>")
    sound = bytearray((site / "stream.gss").read_bytes())
    sound[200] ^= 255
    (site / "damaged.gss").write_bytes(sound)
    said = f"{MESSAGE} && {MESSAGE} !== 'Loading …'"
    with serving(site) as (url, _), serving(site) as (other, _):
        steps = [
            ["go", f"{url}/index.html?src={name.replace('OTHER', other)}"],
            ["until", said, 20],
            ["evaluate", MESSAGE],
        ]
        (*_, text), _ = try_in_browser(steps, tmp_path)
    for words in CASES[name]:
        assert words in text, text
    assert "played" not in text, "nothing was loaded"
    assert text.endswith(".")


def test_offline_is_said(site, tmp_path):
    offline = {"offline": True, "latency": 0, "downloadThroughput": -1, "uploadThroughput": -1}
    steps = [
        WITHOUT_WORKERS,
        ["go", "URL/index.html"],
        READY,
        ["send", "Network.emulateNetworkConditions", offline],
        ["evaluate", f"{PLAYER}.open('other.gss').catch(() => {{}})"],
        ["until", f"{MESSAGE}.includes('offline')"],
    ]
    with serving(site) as (url, _):
        try_in_browser(at(url, steps), tmp_path)


@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl is not installed, which makes a certificate")
def test_http_from_a_page_with_https_is_said(site, tmp_path):
    key, certificate = tmp_path / "key.pem", tmp_path / "certificate.pem"
    make = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "1", "-subj", "/CN=127.0.0.1"]
    subprocess.run([*make, "-keyout", str(key), "-out", str(certificate)], check=True, capture_output=True)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, key)
    flags = ["--ignore-certificate-errors", "--host-resolver-rules=MAP other.test 127.0.0.1"]
    with serving(site) as (plain, _), serving(site) as (safe, server):
        server.socket = context.wrap_socket(server.socket, server_side=True)
        page = safe.replace("http:", "https:")
        steps = [
            ["go", f"{page}/index.html?src={plain.replace('127.0.0.1', 'other.test')}/stream.gss"],
            ["until", f"{MESSAGE}.includes('by https')", 20],
            ["go", f"{page}/index.html"],
            READY,
        ]
        try_in_browser(steps, tmp_path, flags=flags)


@needs_node
def test_reasons_differ(tmp_path):
    code = """
    const { reasonOf } = await load('download.js');
    const fail = () => { throw new TypeError(); };
    const found = [];
    for (const [url, origin, onLine, answers] of given)
      found.push(await reasonOf(url, async () => answers || fail(), { origin, navigator: { onLine } }));
    return found;"""
    cases = [
        ("http://a.example/s.gss", "https://a.example", True, True),
        ("https://b.example/s.gss", "https://a.example", True, True),
        ("https://b.example/s.gss", "https://a.example", True, False),
        ("https://a.example/s.gss", "https://a.example", False, False),
        ("https://a.example/s.gss", "https://a.example", True, False),
        ("http://127.0.0.1:8000/s.gss", "https://a.example", True, True),
    ]
    https, cors, nobody, offline, same, local = node(code, json.loads(json.dumps(cases)), tmp_path)
    assert "by https" in https
    assert "CORS" in cors
    assert "no server" in nobody
    assert "offline" in offline
    assert same is None
    assert "CORS" in local
