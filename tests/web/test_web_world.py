"""The browser player leads back to the recording's coordinates as Python does, and refuses the same worlds."""

from __future__ import annotations

import json
import subprocess
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from node_runs import NODE, needs_node

from gsstream.core.errors import ShapeError
from gsstream.core.world import IDENTITY, World
from gsstream.packet.meta import meta_to_json
from gsstream.player.playback import Playback

pytestmark = needs_node
HERE = Path(__file__).parent
SAMPLE = HERE.parent / "packet" / "samples" / "2.0" / "world.gss"
CANDIDATES = [
    asdict(IDENTITY), {**asdict(IDENTITY), "scale": 0.0}, {**asdict(IDENTITY), "scale": -2.0},
    {**asdict(IDENTITY), "rotation": [-1.0, 0, 0, 0, 1, 0, 0, 0, 1]}, {**asdict(IDENTITY), "offset": [1.0, 2.0]},
    {**asdict(IDENTITY), "rotation": [1.0, 0, 0, 0, 1, 0, 0, 1e-5, 1]},
    {**asdict(IDENTITY), "rotation": [1.0, 0, 0, 0, 1, 0, 0, 1e-8, 1]},
]  # fmt: skip


@pytest.mark.parametrize("identity", [False, True])
def test_points_and_views_lead_back_to_the_recording(tmp_path, identity):
    with Playback(SAMPLE) as playback:
        meta = replace(playback.meta, world=IDENTITY) if identity else playback.meta
    points = np.random.default_rng(0).normal(size=(5, 3))
    given = {"meta": json.loads(meta_to_json(meta)), "points": points.tolist(), "candidates": CANDIDATES}
    (tmp_path / "given.json").write_text(json.dumps(given))
    command = [str(NODE), str(HERE / "world.mjs"), str(tmp_path / "given.json")]
    found = json.loads(subprocess.run(command, capture_output=True, check=True, timeout=60).stdout)
    assert np.array(found["points"]) == pytest.approx(meta.world.points(points), rel=1e-14)
    poses = np.concatenate([meta.world.cameras(rig).viewmats for rig in (meta.test, meta.train)])
    assert np.array(found["poses"]) == pytest.approx(poses, rel=1e-12, abs=1e-8)
    assert found["valid"] == [_is_valid(candidate) for candidate in CANDIDATES]


def _is_valid(candidate: dict) -> bool:
    try:
        World(tuple(candidate["rotation"]), tuple(candidate["offset"]), candidate["scale"]).validate()
    except ShapeError:
        return False
    return True
