"""The ways of going on: what a player has is what the encoder goes on from in a closed loop, and only there."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from gsstream.engine.assembly.assemble import assemble
from gsstream.plugins.catalog import load_catalog
from gsstream.recipe.load import resolve_recipe
from tools.open_loop import HARDLY, WAYS, finer, main

SOURCE = "synthetic:frames=3&views=3&width=48&height=36&supersample=1"


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    out = tmp_path_factory.mktemp("open_loop")
    command = ["--source", SOURCE, "--frames", "4", "--out", str(out), "--set", "first_frame.max_iterations=20"]
    assert main([*command, "--set", "stream.epochs=2"]) == 0
    return dict(json.loads((out / "open_loop.json").read_text()))


def test_only_an_open_loop_leaves_the_player(found: dict[str, Any]) -> None:
    assert list(found) == [way.name for way in WAYS]
    for way in WAYS:
        same = [frame["same"] for frame in found[way.name]["frames"]]
        assert same == ([True, False, False, False] if way.open_loop else [True] * 4)


def test_all_ways_share_frame_0_and_each_is_an_experiment_of_its_own(found: dict[str, Any]) -> None:
    firsts = {found[way.name]["frames"][0]["psnr"] for way in WAYS}
    assert len(firsts) == 1
    lasts = {found[way.name]["frames"][-1]["psnr"] for way in WAYS}
    assert len(lasts) == len(WAYS)


def test_finer_steps_round_by_next_to_nothing() -> None:
    catalog = load_catalog()
    parts = assemble(resolve_recipe("dense", catalog.recipe_path, [], []), catalog)
    fine = assemble(finer(parts.recipe), catalog).update
    for name, code in parts.update.codes().items():
        assert fine.codes()[name].step == pytest.approx(HARDLY * code.step)
        assert np.isclose(fine.codes()[name].lr, code.lr), "only the rounding is to differ"
