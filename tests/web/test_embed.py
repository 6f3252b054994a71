"""The player as a part of other people's pages, in a real browser: what it leaves to the page, and how it looks."""

from __future__ import annotations

import pytest
from browser_runs import in_browser, needs_browser, serving

pytestmark = needs_browser
PLAYER = "document.querySelector('gsstream-player')?.player"
ROOT = "document.querySelector('gsstream-player').shadowRoot"
READY = ["until", f"{PLAYER}?.statistics.drawn"]


@pytest.mark.parametrize("limits", ["", "none"])
def test_a_hand_that_leaves_the_recorded_region_comes_back_unless_it_is_free(site, tmp_path, limits):
    opacity = f"Number({ROOT}.querySelector('canvas').style.opacity || 1)"
    state = f"[{opacity}, document.querySelector('gsstream-player').controls.outside, {PLAYER}.view.eye.join()]"
    steps = [
        ["go", f"URL/index.html?limits={limits}"], READY, ["evaluate", state],
        ["hold", 300, 100, 400, 0], ["pause", 500], ["evaluate", state],
        ["release", 700, 100], ["pause", 200], ["until", f"{opacity} === 1"], ["evaluate", state],
    ]  # fmt: skip
    with serving(site) as (url, _):
        results = in_browser([[s.replace("URL", url) if isinstance(s, str) else s for s in step] for step in steps],
                             tmp_path)  # fmt: skip
    first, held, left = results[2], results[5], results[9]
    assert first[:2] == [1, 0]
    assert first[2] != held[2]
    if limits:
        assert (held[:2], left) == ([1, 0], held), "nothing fades, and the view stays where the hand left it"
    else:
        assert held[1] == pytest.approx(1), "the hand pulls as far as it may"
        assert held[0] == pytest.approx(0)
        assert left[1] == pytest.approx(0, abs=1e-9)
        assert left[2] != held[2]
