"""The recorded region and the recording's coordinates: one rule in Python and in the page."""

from __future__ import annotations

import json
import subprocess
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from node_runs import NODE, needs_node, node

from gsstream.core.cameras import Cameras
from gsstream.core.errors import ShapeError
from gsstream.core.world import IDENTITY, World
from gsstream.packet.meta import meta_to_json
from gsstream.player.paths import camera_path
from gsstream.player.playback import Playback
from gsstream.player.region import MIN_SWING, Region, recorded_region
from tests.rigs import looking

TURN = 2 * np.pi


def rig_of(centers, targets) -> Cameras:
    """Cameras at places [C, 3] that look at a target each."""
    return looking(centers, targets, K=[[60.0, 0, 32], [0, 60.0, 24], [0, 0, 1]], size=(64, 48))


def ring(number: int, span: float = TURN, radius: float = 3.0, height: float = 1.0, start: float = 0.3) -> np.ndarray:
    """[number, 3] places on an arc."""
    angles = start + np.linspace(0, span, number, endpoint=span != TURN)
    return np.stack([radius * np.cos(angles), radius * np.sin(angles), np.full(number, height)], 1)


def turned(rig: Cameras, seed: int, scale: float, offset: float) -> Cameras:
    """The same rig anywhere, rotated and in another unit."""
    rng = np.random.default_rng(seed)
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    centers = scale * rig.centers @ rotation.T + offset * rng.normal(size=3)
    viewmats = rig.viewmats.copy()
    viewmats[:, :3, :3] = rig.viewmats[:, :3, :3] @ rotation.T
    viewmats[:, :3, 3] = -np.einsum("cij,cj->ci", viewmats[:, :3, :3], centers)
    return replace(rig, viewmats=viewmats)


LINE = np.stack([np.linspace(-1, 1, 5), np.full(5, -4.0), np.full(5, 0.5)], 1)
#: Parallel cameras turn around a point as far before them as their rig is wide.
FAN = float(np.degrees(2 * np.arctan(1 / 1.1)))
#: name: cameras, whether they look outward, degrees of the range of the azimuth (None: free).
RIGS: dict[str, tuple[Cameras, bool, float | None]] = {
    "ring": (rig_of(ring(12), (0, 0, 0)), False, None),
    "four around": (rig_of(ring(4), (0, 0, 0)), False, None),
    "three around": (rig_of(ring(3), (0, 0, 0)), False, 240),
    "two opposite": (rig_of(ring(2), (0, 0, 0.5)), False, 180),
    "two face to face": (rig_of(ring(2, height=0), (0, 0, 0)), False, 180),
    "two back to back": (rig_of(ring(2, height=0), 2 * ring(2, height=0)), True, 180),
    "arc": (rig_of(ring(8, np.pi / 2), (0, 0, 0)), False, 90),
    "arc, and one from above": (rig_of([*ring(8, np.pi / 2), (1e-12, 0, 4)], (0, 0, 0)), False, 90),
    "dome": (rig_of(np.concatenate([ring(8, height=h) for h in (-2.0, 0.5, 4.0)]), (0.1, 0, 0)), False, None),
    "line": (rig_of(LINE, (0, 0, 0)), False, float(np.degrees(2 * np.arctan(1 / 4)))),
    "parallel": (rig_of(LINE, LINE * (1, 1, 1) + (0, 1, 0)), False, FAN),
    "parallel but for a little": (rig_of(LINE, LINE * (1.05, 1, 1) + (0, 1, 0)), False, FAN),
    "parallel as far as a calibration says": (rig_of(LINE, LINE * (0.995, 1, 1) + (0, 1, 0)), False, FAN),
    "arc, and one from high up": (
        rig_of([*ring(8, np.pi / 2), *ring(1, 0, 1.0, 2.7, start=3.3)], (0, 0, 0)),
        False,
        float(np.degrees(3.0)),
    ),
    "one": (rig_of([(3, 1, 2)], (0, 0, 0)), False, float(np.degrees(2 * MIN_SWING))),
    "side by side": (rig_of([(3, 0, 1), (3, 0.1, 1)], (0, 0, 0)), False, float(np.degrees(2 * MIN_SWING))),
    "far away": (rig_of(ring(6, 0.3, radius=300, height=20), (0, 0, 0)), False, float(np.degrees(2 * MIN_SWING))),
    "outward ring": (rig_of(ring(8, radius=1, height=0), ring(8, radius=2, height=0)), True, None),
    "outward arc": (rig_of(ring(5, 2.5, 1, 0), ring(5, 2.5, 2, 0)), True, float(np.degrees(2.5))),
    "one place, all around": (rig_of(np.zeros((6, 3)), ring(6, height=0)), True, None),
    "one place, half around": (rig_of(np.zeros((5, 3)), ring(5, np.pi, height=0.2)), True, 180),
    "far from the origin": (turned(rig_of(ring(7, 2.0), (0, 0, 0)), 1, 0.2, 1e4), False, float(np.degrees(2.0))),
    "rotated ring": (turned(rig_of(ring(9), (0, 0, 0)), 2, 40.0, 3.0), False, None),
}


def limits(region: Region) -> dict[str, object]:
    """A region as the page has it."""
    return {
        "azimuth": None if region.azimuth is None else list(region.azimuth),
        "elevation": list(region.elevation),
        "distance": list(region.distance),
        "focus": region.focus.tolist(),
        "up": region.up.tolist(),
        "outward": region.outward,
    }


@pytest.mark.parametrize("name", RIGS)
def test_a_region_is_as_wide_as_the_cameras_and_excludes_none_of_them(name):
    rig, outward, degrees = RIGS[name]
    region = recorded_region(rig)
    assert region.outside(rig) == pytest.approx(np.zeros(len(rig)), abs=1e-9)
    assert region.outward is outward
    if degrees is None:
        assert region.azimuth is None
    else:
        assert region.azimuth is not None
        assert 2 * np.degrees(region.azimuth[1]) == pytest.approx(degrees, abs=0.1)


@pytest.mark.parametrize("name", RIGS)
def test_an_orbit_stays_in_the_region_and_looks_as_its_cameras_do(name):
    rig, outward, _ = RIGS[name]
    region = recorded_region(rig)
    path = camera_path("orbit", rig, 24)
    path.validate()
    assert region.outside(path) == pytest.approx(np.zeros(24), abs=1e-6)
    wanted = region.arms(path) if outward else region.focus - path.centers
    ahead = np.einsum("ci,ci->c", path.viewmats[:, 2, :3], wanted)
    assert ahead.min() > 0


def test_what_is_behind_the_cameras_of_an_arc_fades():
    region = recorded_region(RIGS["arc"][0])
    around = rig_of(ring(36, start=0.3), (0, 0, 0))
    azimuth = np.degrees(np.arange(36) * TURN / 36)
    outside = region.outside(around)
    assert (outside[azimuth <= 90] < 1e-9).all()
    assert (outside[(azimuth >= 101) & (azimuth <= 349)] == 1).all()
    assert outside[azimuth == 0][0] == 0
    heights = rig_of([(3 * np.cos(1), 3 * np.sin(1), z) for z in (-3, 0.6, 1, 1.4, 8)], (0, 0, 0))
    assert region.outside(heights)[[0, 4]].tolist() == [1, 1]
    assert (region.outside(heights)[1:4] == 0).all()
    reach = rig_of([np.array([np.cos(1), np.sin(1), 1 / 3]) * d for d in (0.5, 1.6, 4.4, 9)], (0, 0, 0))
    assert region.outside(reach).tolist() == [1, 0, 0, 1]


PAGE = """
const { viewsOf, pivotOf, orbited, looked, moved, zoomed } = await load("camera.js");
const { regionOf, outside, returned } = await load("region.js");
const rows = (rig) => ({ ids: rig.viewmats.map((_, i) => `c${i}`), viewmats: rig.viewmats, Ks: rig.Ks, width: 64,
  height: 48, near: 0.01 });
const none = { ids: [] };
return given.map(({ rig, others, hands }) => {
  const views = viewsOf({ test: rows(rig), train: none });
  const pivot = pivotOf(views);
  const region = regionOf(views, pivot);
  const at = viewsOf({ test: rows(others), train: none });
  // A hand that drags at random, held as the page holds it; then let go.
  const worst = { free: 0, left: 0, moved: 0 };
  for (const view of views) {
    const stays = returned(region, view, pivot, 0);
    worst.moved = Math.max(worst.moved, Math.hypot(...stays.view.eye.map((v, k) => v - view.eye[k])));
    let now = { view, pivot };
    for (const [yaw, pitch, factor, ...step] of hands) {
      const turned = looked(orbited(now.view, now.pivot, yaw, pitch), now.pivot, yaw / 5, pitch / 5);
      const next = moved(zoomed(turned, now.pivot, factor), now.pivot, step);
      worst.free = Math.max(worst.free, outside(region, next.view, next.pivot));
      now = returned(region, next.view, next.pivot, 1);
    }
    now = returned(region, now.view, now.pivot, 0);
    worst.left = Math.max(worst.left, outside(region, now.view, now.pivot));
  }
  return { limits: { ...region, up: pivot.up, outward: pivot.outward },
    outside: at.map((view) => outside(region, view, pivot)), worst };
});
"""


@needs_node
def test_the_page_has_the_same_limits_and_keeps_them(tmp_path):
    rng = np.random.default_rng(3)
    given, expected = [], []
    for rig, *_ in RIGS.values():
        region = recorded_region(rig)
        spread = rig.extent * rng.normal(size=(40, 3))
        others = rig_of(rig.centers.mean(0) + 2 * spread, region.focus + rig.extent * rng.normal(size=(40, 3)))
        hands = np.concatenate(
            [rng.normal(size=(60, 2)), np.exp(rng.normal(size=(60, 1))), rig.extent * rng.normal(size=(60, 3))], 1
        )
        given.append(
            {
                "rig": {"viewmats": rig.viewmats.reshape(-1, 16).tolist(), "Ks": rig.Ks.reshape(-1, 9).tolist()},
                "others": {
                    "viewmats": others.viewmats.reshape(-1, 16).tolist(),
                    "Ks": others.Ks.reshape(-1, 9).tolist(),
                },
                "hands": hands.tolist(),
            }
        )
        expected.append((limits(region), region.outside(others), rig.extent))
    for name, found, (wanted, outside, extent) in zip(RIGS, node(PAGE, given, tmp_path), expected, strict=True):
        for part, value in wanted.items():
            got = found["limits"][part]
            assert got == (value if value is None else pytest.approx(value, abs=1e-6)), (name, part)
        assert found["outside"] == pytest.approx(outside, abs=1e-6), name
        assert found["worst"]["moved"] <= 1e-6 * extent, f"{name}: a camera of the rig is held back"
        assert found["worst"]["free"] == 1, f"{name}: the hand never left the region, so the test tested nothing"
        assert found["worst"]["left"] <= 1e-6, name


HERE = Path(__file__).parent
SAMPLE = HERE.parent / "packet" / "samples" / "2.0" / "world.gss"
CANDIDATES = [
    asdict(IDENTITY),
    {**asdict(IDENTITY), "scale": 0.0},
    {**asdict(IDENTITY), "scale": -2.0},
    {**asdict(IDENTITY), "rotation": [-1.0, 0, 0, 0, 1, 0, 0, 0, 1]},
    {**asdict(IDENTITY), "offset": [1.0, 2.0]},
    {**asdict(IDENTITY), "rotation": [1.0, 0, 0, 0, 1, 0, 0, 1e-5, 1]},
    {**asdict(IDENTITY), "rotation": [1.0, 0, 0, 0, 1, 0, 0, 1e-8, 1]},
]


@needs_node
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
