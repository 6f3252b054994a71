"""Events for the synthetic scene: something stops, turns back, bounces, hides, enters or opens at a known frame.

The frame is the option ``event`` (E below). Everything is analytic, so that places, depths and masks are exact.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from gsstream.core.rng import Rng
from gsstream.core.shapes import FloatArray
from gsstream.input.recordings.primitives import Box, Placed, Shape, Sphere, Surface
from gsstream.input.recordings.toyroom import moving_shapes, static_shapes

SceneName = Literal[
    "paths", "stop", "reversal", "bounce", "occlusion", "flash", "dropout", "enters", "door"
]
#: Way of a body in one frame at motion 1, metres: about 5 pixels at a width of 160.
STEP = 0.08
#: Light of the frame of a flash, times that of the others.
FLASH = 1.6
#: Number of frames for which the camera of "dropout" gives nothing.
DROPPED = 4
#: Scenes whose objects go the way of "paths", with another clock or none.
_ON_PATHS = ("paths", "stop", "reversal", "flash", "dropout")
_BALL, _DOOR, _PICTURE = "ball", "door", "picture"


@dataclass(frozen=True, slots=True)
class ToyScene:
    """What stands, and what moves at which frame.

    Arguments:
        name: of the scene.
        seed: of textures and of the starting phase.
        motion: speed; 0: nothing moves.
        event: the frame E at which it happens.
    """

    name: SceneName
    seed: int
    motion: float
    event: int

    def static(self) -> list[Placed]:
        """Return the room (first) and what never moves."""
        shapes = static_shapes(self.seed)
        if self.name == "occlusion":
            # A closed box across the track: inside it the ball is hidden from everywhere.
            tunnel = Box("tunnel", (0.17, 0.3, 0.17), _surface(0, (0.35, 0.4, 0.4)))
            shapes.append((tunnel, np.array([0.75, 0.0, 0.17])))
        if self.name == "door":
            shapes.append((Box("cabinet", (0.12, 0.42, 0.28), _surface(1, (0.4, 0.3, 0.2))), _CABINET))
        return shapes + self.revealed()

    def moving(self, index: int) -> list[Placed]:
        """Return what moves, where it is at a frame."""
        if self.name in _ON_PATHS:
            return moving_shapes(self.seed, self.phase(index))
        radius = 0.13 if self.name == "occlusion" else 0.18
        return [(_shape(name, radius), center) for name, center in self.centers(index).items()]

    def centers(self, index: int) -> dict[str, FloatArray]:
        """Return the centre [3] of each moving object at a frame, scene units."""
        if self.name in _ON_PATHS:
            return {shape.name: center for shape, center in moving_shapes(self.seed, self.phase(index))}
        way = STEP * self.motion * (index - self.event)
        if self.name == "bounce":
            # Up and down between floor and 0.9 m, there and back between two walls nobody sees; the floor at frame E.
            return {_BALL: np.array([0.7, _zigzag(way, 0.8), 0.18 + _above(way, 0.72)])}
        if self.name == "occlusion":
            return {_BALL: np.array([0.75, _zigzag(way - 0.16, 1.1), 0.13])}
        if self.name == "enters":
            # From above every camera's picture down to where it stays; its edge is in one of them at frame E.
            return {_BALL: np.array([0.45, 0.1, min(max(0.78, 1.54 - way), 2.75)])}
        side = min(max(way + STEP * self.motion, 0.0), 0.76)
        return {_DOOR: _CABINET + np.array([0.155, side, 0])}

    def revealed(self) -> list[Placed]:
        """Return the shapes at rest that something uncovers: no camera sees them at frame 0."""
        return [(_PLATE, _CABINET + np.array([0.13, 0, 0]))] if self.name == "door" else []

    def phase(self, index: int) -> float:
        """Return the place of the objects on their paths, radians."""
        start = Rng(self.seed).numpy("synthetic phase").uniform(0, 2 * np.pi)
        clock = {"stop": min(index, self.event), "reversal": self.event - abs(index - self.event)}.get(self.name, index)
        return float(start + 2 * np.pi * (self.motion * clock / 60.0))

    def light(self, index: int) -> float:
        """Return the factor on all colours at a frame."""
        return FLASH if self.name == "flash" and index == self.event else 1.0

    def shown(self, camera: int, index: int) -> int:
        """Return the frame whose picture a training camera delivers: when it drops out, the last one it has taken."""
        out = self.name == "dropout" and camera == 1 and self.event <= index < self.event + DROPPED
        return self.event - 1 if out else index


_CABINET: FloatArray = np.array([-0.1, 0.0, 0.89])
_PLATE: Shape = Box(_PICTURE, (0.01, 0.33, 0.24), Surface((0.85, 0.75, 0.25), contrast=0.5, frequency=30.0, phase=2.0))


def _shape(name: str, radius: float) -> Shape:
    if name == _DOOR:
        return Box(_DOOR, (0.012, 0.38, 0.27), _surface(2, (0.3, 0.45, 0.6)))
    return Sphere(_BALL, radius, _surface(3, (0.8, 0.25, 0.15)))


def _surface(number: int, color: tuple[float, float, float]) -> Surface:
    return Surface(color, frequency=22.0, phase=1.0 + number)


def _above(way: float, top: float) -> float:
    """Height after a way at constant speed between 0 and ``top``, 0 at the start, turning at both ends."""
    return abs((way + top) % (2 * top) - top)


def _zigzag(way: float, half: float) -> float:
    """Place after a way at constant speed between -half and half, starting at 0 upwards, turning at both ends."""
    return abs((way - half) % (4 * half) - 2 * half) - half
