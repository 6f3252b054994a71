"""Recipes and scenes that once failed in the soak job; each is a run from its first to its last frame."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from flow_runs import encode, metrics

TINY_WORLD = "synthetic:frames=3&views=3&width=16&height=12&supersample=1"
GROWING = {"first_frame__densify_from": 4, "first_frame__densify_every": 4, "first_frame__max_iterations": 20}


@pytest.mark.parametrize("method", ["dense", "queen-published"])
def test_the_reference_renderer_can_grow_a_scene(tmp_path: Path, method: str) -> None:
    """Densification asks a session for the gradient of the 2-D means."""
    settings: dict[str, Any] = {**GROWING, "stream__epochs": 4, "first_frame__densify_gradient": 1e-6}
    encode(tmp_path, "--renderer", "reference", source=TINY_WORLD, method=method, **settings)
    assert [line["status"] for line in metrics(tmp_path)] == ["key", "delta", "delta"]
