"""Events for the synthetic scene: bodies stop, turn back, bounce or hide, or the light changes, at a known frame.

The frame is the option ``event`` (E below). Everything is analytic, so that places, depths and masks are exact.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from gsstream.core.rng import Rng
from gsstream.core.shapes import FloatArray
from gsstream.input.recordings.primitives import Box, Placed, Sphere, Surface
from gsstream.input.recordings.toyroom import moving_shapes, static_shapes

SceneName = Literal["paths", "stop", "reversal", "bounce", "occlusion", "flash", "lamp", "dim", "cloud"]
#: Path of a body from one frame to the next with the option motion = 1, metres: about 5 pixels at a width of 160.
STEP = 0.08
#: Light in the frame of a flash, as a multiple of the light in other frames.
FLASH = 1.6
#: Light after a lamp is switched on, as a multiple of the light before.
LAMP = 1.3
#: Share of the light that is lost in every frame while the light dims, and the share that is left in the end.
DIM, DARKEST = 0.0025, 0.6
#: Half of the width of the cloud's rim, metres: on the one side of it the light falls, on the other it stays.
RIM = 0.6
#: Scenes whose objects go the way of "paths", with another clock or none.
_ON_PATHS = ("paths", "stop", "reversal", "flash", "lamp", "dim", "cloud")


@dataclass(frozen=True, slots=True)
class ToyScene:
    """What stands, and what moves at which frame."""

    name: SceneName  # of the scene
    seed: int  # of textures and of the starting phase
    motion: float  # speed; 0: nothing moves
    event: int  # the frame E at which it happens

    def static(self) -> list[Placed]:
        """Return the room (first) and what never moves."""
        shapes = static_shapes(self.seed)
        if self.name == "occlusion":
            # A closed box across the track: inside it the ball is hidden from everywhere.
            tunnel = Box("tunnel", (0.17, 0.3, 0.17), _surface(0, (0.35, 0.4, 0.4)))
            shapes.append((tunnel, np.array([0.75, 0.0, 0.17])))
        return shapes

    def moving(self, index: int) -> list[Placed]:
        """Return what moves, where it is at a frame."""
        if self.name in _ON_PATHS:
            return moving_shapes(self.seed, self.phase(index))
        radius = 0.13 if self.name == "occlusion" else 0.18
        ball = Sphere("ball", radius, _surface(3, (0.8, 0.25, 0.15)))
        return [(ball, self.centers(index)["ball"])]

    def centers(self, index: int) -> dict[str, FloatArray]:
        """Return the centre [3] of each moving object at a frame, scene units."""
        if self.name in _ON_PATHS:
            return {shape.name: center for shape, center in moving_shapes(self.seed, self.phase(index))}
        way = STEP * self.motion * (index - self.event)
        if self.name == "bounce":
            # A body that goes up and down between the floor and 0.9 m, and to and fro between two walls that no camera
            # sees; at frame E it is on the floor.
            return {"ball": np.array([0.7, _zigzag(way, 0.8), 0.18 + _above(way, 0.72)])}
        return {"ball": np.array([0.75, _zigzag(way - 0.16, 1.1), 0.13])}

    def phase(self, index: int) -> float:
        """Return the place of the objects on their paths, radians."""
        start = Rng(self.seed).numpy("synthetic phase").uniform(0, 2 * np.pi)
        clock = {"stop": min(index, self.event), "reversal": self.event - abs(index - self.event)}.get(self.name, index)
        return float(start + 2 * np.pi * (self.motion * clock / 60.0))

    def light(self, index: int) -> float:
        """Return the factor on all colours at a frame."""
        late = index - self.event
        if self.name == "dim":
            return _dimmed(late)
        if self.name == "lamp":
            return LAMP if late >= 0 else 1.0
        return FLASH if self.name == "flash" and late == 0 else 1.0

    def shade(self, index: int, places: FloatArray) -> FloatArray:
        """Return the cloud's factor [P] on the colours of places [P, 3], scene units: below 1 where y > 0."""
        under = np.clip(0.5 + places[:, 1] / (2 * RIM), 0, 1).astype(np.float32)
        factor: FloatArray = 1 - under * np.float32(1 - _dimmed(index - self.event))
        return factor


def _dimmed(late: int) -> float:
    """Light that is left so many frames after it began to fall."""
    return max(1 - DIM * max(late, 0), DARKEST)


def _surface(number: int, color: tuple[float, float, float]) -> Surface:
    return Surface(color, frequency=22.0, phase=1.0 + number)


def _above(way: float, top: float) -> float:
    """Height after a way at constant speed between 0 and ``top``, 0 at the start, turning at both ends."""
    return abs((way + top) % (2 * top) - top)


def _zigzag(way: float, half: float) -> float:
    """Place after a way at constant speed between -half and half, starting at 0 upwards, turning at both ends."""
    return abs((way - half) % (4 * half) - 2 * half) - half
