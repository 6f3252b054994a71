"""Recipes and scenes that once failed in the soak job; each is a run from its first to its last frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from early_densify import densifying
from flow_runs import Witness, encode, metrics

from gsstream.player.playback import Playback

TINY_WORLD = "synthetic:frames=3&views=3&width=16&height=12&supersample=1"

@pytest.mark.parametrize("method", ["dense", "queen-published"])
def test_the_reference_renderer_can_grow_a_scene(tmp_path: Path, method: str) -> None:
    """Densification asks a session for the gradient of the 2-D means."""
    # In pictures this small, pruning leaves nothing of the scene itself.
    behind = {"first_frame__shell": True, "background": "auto"}
    settings: dict[str, Any] = {"first_frame__max_iterations": 20, "stream__epochs": 4, **behind}
    with densifying(4, 4, 1e-6):
        encode(tmp_path, "--set", "renderer=reference", source=TINY_WORLD, method=method, **settings)
    assert [line["status"] for line in metrics(tmp_path)] == ["key", "delta", "delta"]


@pytest.mark.parametrize("method", ["s2gs-edge", "queen"])
def test_images_as_bytes_lose_nothing_of_8_bits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str) -> None:
    """At full size the recording has 8 bits: every frame decodes to the same scene."""
    witness = Witness(monkeypatch)
    scenes = []
    for storage in ("float32", "auto"):
        encode(tmp_path / storage, "--frames", "4", method=method, data__images=storage)
        with Playback(tmp_path / storage / "stream.gss") as playback:
            scenes.append([playback.state_at(frame).means.tobytes() for frame in playback.frames])
    assert scenes[0] == scenes[1]
    assert len(set(scenes[0])) > 1
    if method == "s2gs-edge":
        assert witness.states[-1].previous.images.dtype == np.uint8
