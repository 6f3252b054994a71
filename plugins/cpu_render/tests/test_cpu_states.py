"""In which state a rasteriser takes which call: the table of rasterizer.hpp, tried out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from cpu_scenes import HEIGHT, WIDTH, random_splats, rasterizer, rows_of, upstream
from gsstream_cpu_render.rasterizer import NumpyRasterizer

from gsstream.api import InputError

SPLATS = random_splats(60, 3, 4)
IDS = np.arange(2, 60, 5, dtype=np.uint32)
V_IMAGE = upstream(0)[0]
FORWARD, FREEZE = "expected a forward pass of the whole scene", "expected freeze"
PASS, ACTIVE = "expected a forward pass before", "expected a forward_active pass before"


def picture() -> tuple[Any, Any]:
    return np.zeros((HEIGHT, WIDTH, 3), np.float32), np.ones((HEIGHT, WIDTH), np.float32)


CALLS: dict[str, Callable[[NumpyRasterizer], object]] = {
    "forward": lambda r: r.forward(SPLATS),
    "backward": lambda r: r.backward(V_IMAGE),
    "freeze": lambda r: r.freeze(None, IDS),
    "forward_active": lambda r: r.forward_active(rows_of(SPLATS, IDS)),
    "backward_active": lambda r: r.backward_active(V_IMAGE),
    "update": lambda r: r.update(IDS, rows_of(SPLATS, IDS), *picture()),
    "backward_cached": lambda r: r.backward_cached(SPLATS, V_IMAGE),
    "contributing_in_cache": lambda r: r.contributing_in_cache(None),
    "forward_cached": lambda r: r.forward_cached(),
    "forget": lambda r: r.forget(),
    "free_scratch": lambda r: r.free_scratch(),
}
ANY = {"forward", "forget", "free_scratch"}
CACHED = ANY | {"freeze", "update", "backward_cached", "contributing_in_cache", "forward_cached"}
#: State: the calls that lead to it, and those it takes.
STATES = {
    "forgotten": (["forward", "forget"], CACHED),
    "cached": (["forward", "forward_cached"], CACHED),
    "cached by an update": (["forward", "freeze", "forward_active", "update"], CACHED),
    "cached, scratch shed": (["forward", "freeze", "free_scratch"], CACHED),
    "passed": (["forward"], CACHED | {"backward"}),
    "passed, looked at": (["forward", "backward", "contributing_in_cache", "backward_cached"], CACHED | {"backward"}),
    "frozen": (["forward", "freeze"], CACHED | {"forward_active"}),
    "frozen, pass forgotten": (["forward", "freeze", "forward_active", "forward_cached"], CACHED | {"forward_active"}),
    "active_passed": (["forward", "freeze", "forward_active"], CACHED | {"forward_active", "backward_active"}),
    "active_passed, looked at": (
        ["forward", "freeze", "forward_active", "backward_active", "contributing_in_cache", "backward_cached"],
        CACHED | {"forward_active", "backward_active"},
    ),
}  # fmt: skip
MESSAGES = {"backward": PASS, "backward_active": ACTIVE, "forward_active": FREEZE}


@pytest.mark.parametrize("call", CALLS)
@pytest.mark.parametrize("state", STATES)
def test_a_state_takes_these_calls_and_no_others(state: str, call: str) -> None:
    subject = rasterizer()
    path, taken = STATES[state]
    for step in path:
        CALLS[step](subject)
    if call in taken:
        CALLS[call](subject)
        return
    with pytest.raises(InputError, match=f"{call}: {MESSAGES.get(call, FORWARD)}"):
        CALLS[call](subject)
    # A refusal changes nothing: what the state takes it still takes.
    for other in sorted(taken - {"forward", "update", "freeze", "forget", "free_scratch", "forward_cached"}):
        CALLS[other](subject)


@pytest.mark.parametrize("call", ["backward", "freeze", "forward_active", "backward_active", "contributing_in_cache"])
def test_a_new_rasteriser_takes_none_that_needs_a_pass(call: str) -> None:
    with pytest.raises(InputError, match=f"{call}: {MESSAGES.get(call, FORWARD)}"):
        CALLS[call](rasterizer())


def test_a_pass_that_fails_leaves_the_state_before_it() -> None:
    subject = rasterizer()
    bad = rows_of(SPLATS, IDS)
    bad.means[1, 1] = np.nan
    subject.forward(SPLATS)
    subject.freeze(None, IDS)
    with pytest.raises(InputError, match="nan"):
        subject.forward_active(bad)
    with pytest.raises(InputError, match=ACTIVE):
        subject.backward_active(V_IMAGE)
    subject.forward_active(rows_of(SPLATS, IDS))  # frozen still
    whole = random_splats(60, 3, 4)
    whole.means[5, 0] = np.inf
    with pytest.raises(InputError, match="inf"):
        subject.forward(whole)
    for call in ("freeze", "update", "backward_cached"):
        with pytest.raises(InputError, match=FORWARD):
            CALLS[call](subject)
