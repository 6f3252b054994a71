"""The synthetic scene: a room, four static and two moving shapes, and an arc of cameras. Metres, z up."""

from __future__ import annotations

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.rng import Rng
from gsstream.core.shapes import FloatArray
from gsstream.input.recordings.primitives import Box, Placed, Sphere, Surface

LIGHT: FloatArray = (np.array([0.35, -0.45, 0.82]) / np.linalg.norm([0.35, -0.45, 0.82])).astype(np.float32)
_ROOM_HALF = (3.0, 3.0, 1.5)


def static_shapes(seed: int) -> list[Placed]:
    """Return the room (first) and what stands still in it."""
    surfaces = _surfaces(seed)
    return [
        (Box("room", _ROOM_HALF, surfaces[0], room=True), np.array([0, 0, _ROOM_HALF[2]])),
        (Box("plinth", (0.22, 0.22, 0.3), surfaces[1]), np.array([0.0, 0.0, 0.3])),
        (Box("block", (0.12, 0.12, 0.12), surfaces[2]), np.array([0.35, -0.38, 0.12])),
        (Sphere("globe", 0.2, surfaces[3]), np.array([-0.42, 0.32, 0.2])),
        (Sphere("marble", 0.15, surfaces[4]), np.array([0.32, 0.45, 0.15])),
    ]


def moving_shapes(seed: int, phase: float) -> list[Placed]:
    """Return what moves, at a phase of the path in radians."""
    surfaces, centers = _surfaces(seed), object_centers(phase)
    return [
        (Sphere("ball", 0.18, surfaces[5]), centers["ball"]),
        (Box("crate", (0.13, 0.13, 0.13), surfaces[6]), centers["crate"]),
    ]


def object_centers(phase: float) -> dict[str, FloatArray]:
    """Return where the ball and the crate are.

    The ball circles the scene and hops twice per turn; the crate flies a figure of eight above the plinth.
    """
    ball = [0.8 * np.cos(phase), 0.8 * np.sin(phase), 0.18 + 0.15 * (1 - np.cos(2 * phase)) / 2]
    crate = [0.3 * np.sin(phase), 0.3 * np.sin(2 * phase), 0.95 + 0.1 * np.cos(phase)]
    return {"ball": np.array(ball), "crate": np.array(crate)}


def arc_cameras(views: int, width: int, height: int) -> Cameras:
    """Return the test camera in the middle of the arc, then ``views`` cameras over 120 degrees."""
    target = np.array([0.0, 0.0, 0.4])
    angles = np.concatenate([[0.0], np.radians(np.linspace(-60, 60, views))])
    heights = np.concatenate([[1.3], np.where(np.arange(views) % 2 == 0, 1.0, 1.6)])
    centers = np.stack([2.3 * np.cos(angles), 2.3 * np.sin(angles), heights], axis=1)
    viewmats = np.stack([_look_at(center, target) for center in centers])
    focal = 0.95 * width
    intrinsics = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]])
    ids = ("test", *(f"cam{i:02d}" for i in range(views)))
    return Cameras(
        ids=ids, viewmats=viewmats, Ks=np.repeat(intrinsics[None], len(ids), axis=0), width=width, height=height
    )


def _look_at(center: FloatArray, target: FloatArray) -> FloatArray:
    forward = (target - center) / np.linalg.norm(target - center)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = -pose[:3, :3] @ center
    return pose


def _surfaces(seed: int) -> list[Surface]:
    rng = Rng(seed).numpy("synthetic surfaces")
    base = [(0.62, 0.58, 0.5), (0.45, 0.5, 0.62), (0.7, 0.62, 0.2), (0.25, 0.6, 0.35), (0.6, 0.3, 0.6)]
    base += [(0.8, 0.25, 0.15), (0.2, 0.4, 0.75)]
    jitter = rng.uniform(-0.06, 0.06, (len(base), 3))
    phases = rng.uniform(0, 2 * np.pi, len(base))
    slow = [6.0, 20.0, 26.0, 22.0, 24.0, 22.0, 24.0]
    return [
        Surface(tuple(np.clip(np.add(color, delta), 0, 1)), frequency=frequency, phase=float(phase))
        for color, delta, frequency, phase in zip(base, jitter, slow, phases, strict=True)
    ]
