"""``gsstream open`` on a recorded stream, without the extra: in a browser, and what else the server answers."""

from __future__ import annotations

import http.client
import re
import signal
import subprocess
import sys
from urllib.parse import urlsplit

import pytest
from browser_runs import in_browser, needs_browser

from gsstream.core.errors import OutputError
from gsstream.serve.local import LocalServer

#: A shell that runs tests in the background has interrupts ignored, and processes inherit that.
CODE = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)
sys.modules.update(dict.fromkeys(["starlette", "uvicorn", "websockets", "torch"]))
from gsstream.cli.main import main
main()
"""


@pytest.fixture(scope="module")
def opened(site, tmp_path_factory):
    """The command as a process, its address, and what it told the browser to show."""
    folder = tmp_path_factory.mktemp("opened")
    browser, shown = folder / "browser", folder / "shown"
    browser.write_text(f"#!/bin/sh\nprintf %s \"$1\" > '{shown}.part' && mv '{shown}.part' '{shown}'\n")
    browser.chmod(0o755)
    command = [sys.executable, "-c", CODE, "open", str(site / "stream.gss")]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env={"BROWSER": f"{browser} %s"}
    ) as process:
        url = re.search(r"http://\S+", process.stdout.readline())
        assert url, process.stderr.read()
        yield process, url[0], shown
        process.kill()


def answer(url: str, path: str, **headers: str) -> tuple[int, bytes]:
    """The path goes to the server as it stands: an ordinary client would mend it first."""
    connection = http.client.HTTPConnection(urlsplit(url).netloc, timeout=10)
    connection.putrequest("GET", path, skip_host="Host" in headers)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    found = connection.getresponse()
    return found.status, found.read()


@needs_browser
def test_the_stream_plays_in_a_browser(opened, tmp_path):
    _, url, _ = opened
    player = "document.querySelector('gsstream-player')?.player"
    steps = [
        ["go", url],
        ["until", f"{player}?.statistics.drawn"],
        ["evaluate", f"{player}.seek(11)"],
        ["until", f"{player}.frame === 11"],
    ]
    in_browser(steps, tmp_path)


def test_nothing_but_the_page_and_the_stream_is_served(opened, site):
    _, url, _ = opened
    assert answer(url, "/stream.gss") == (200, (site / "stream.gss").read_bytes())
    assert answer(url, "/?src=stream.gss")[0] == answer(url, "/", Host="localhost:1")[0] == 200
    assert answer(url, "/", Host="evil.example")[0] == answer(url, "/stream.gss", Host="")[0] == 403
    for path in ("/changes/", "/stream.json", "/../serve/app.py", "/%2e%2e/cli/main.py", "//etc/passwd", "/%00"):
        assert answer(url, path)[0] == 404, path


def test_an_address_in_use_is_told(opened, tmp_path):
    _, url, _ = opened
    with pytest.raises(OutputError, match=r"cannot serve at 127\.0\.0\.1"):
        LocalServer(tmp_path / "stream.gss", urlsplit(url).port)


def test_it_shows_the_address_in_the_browser_and_ends_with_ctrl_c(opened):
    process, url, shown = opened
    process.send_signal(signal.SIGINT)
    assert process.wait(timeout=20) == 130
    assert process.stderr.read() == "interrupted\n"
    assert shown.read_text() == url
