"""Saboteurs of the checks of motion parts."""

from __future__ import annotations

from typing import Any

import numpy as np

from gsstream.core.changes import Motion
from gsstream.parts.motion.base import MotionTraits
from gsstream.testing.examples.motion import ExampleMotion
from gsstream.testing.method_driver import INDEX
from gsstream.testing.motion import BODIES_INDEX
from saboteurs.register import spoils

Base: Any = ExampleMotion
CALLS: dict[str, int] = {"moody": 0, "loose": 0, "own": 0}


def everything(number: int, symbols: int = 1) -> Motion:
    """All of so many groups move by so many tenths."""
    return Motion(1e6, 1, np.ones(number, np.uint8), np.full((number, 6), symbols, np.int32), 0.125, 0.125)


@spoils("check_motion_fits")
class Beyond(Base):
    """Says that a group moves which the scene does not have."""

    def propose(self, scene: Any, work: Any, rng: Any, memory: Any = None) -> Any:
        if work.index != INDEX or not bool(work.changed_rows(0.0).any()):
            return super().propose(scene, work, rng, memory)
        return (everything(5000),)


@spoils("check_motion_pure")
class Moody(Base):
    """Moves farther each time it is asked."""

    def propose(self, scene: Any, work: Any, rng: Any, memory: Any = None) -> Any:
        if work.index != INDEX or not bool(work.changed_rows(0.0).any()):
            return super().propose(scene, work, rng, memory)
        CALLS["moody"] += 1
        number = len(np.unique((scene.gaussians.means < 0) @ np.array([1, 2, 4])))
        return (everything(number, CALLS["moody"]),)


@spoils("check_motion_static_frame")
class Restless(Base):
    """Goes on moving where nothing changes."""

    def propose(self, scene: Any, work: Any, rng: Any, memory: Any = None) -> Any:
        if work.index != INDEX or bool(work.changed_rows(0.0).any()):
            return super().propose(scene, work, rng, memory)
        number = len(np.unique((scene.gaussians.means < 0) @ np.array([1, 2, 4])))
        return (everything(number),)


@spoils("check_motion_closed_loop")
class Loose(Base):
    """Moves farther in every run, not in every frame."""

    def propose(self, scene: Any, work: Any, rng: Any, memory: Any = None) -> Any:
        if work.index != 1:
            return super().propose(scene, work, rng, memory)
        CALLS["loose"] += 1
        number = len(np.unique((scene.gaussians.means < 0) @ np.array([1, 2, 4])))
        return (everything(number, CALLS["loose"]),)


@spoils("check_motion_follow")
class Own(Base):
    """Remembers how often it was called, which a resumed run cannot know."""

    def follow(self, memory: Any, frame: int, before: Any, delta: Any, rng: Any) -> Any:
        CALLS["own"] += 1
        return np.array([CALLS["own"]])


@spoils("check_motion_across_key")
class Counting(Base):
    """Keeps across a key packet how often it was called."""

    def across_key(self, replaced: Any, scene: Any) -> Any:
        CALLS["own"] += 1
        return np.array([CALLS["own"]])


@spoils("check_motion_leaves_unchanged")
class Sweeping(Base):
    """Moves everything as soon as anything changes."""

    traits = MotionTraits()

    def propose(self, scene: Any, work: Any, rng: Any, memory: Any = None) -> Any:
        if work.index != BODIES_INDEX or not bool(work.changed_rows(0.0).any()):
            return super().propose(scene, work, rng, memory)
        return (everything(len(np.unique((scene.gaussians.means < 0) @ np.array([1, 2, 4])))),)


@spoils("check_motion_finds_bodies")
class Blind(Base):
    """Says that it fits motions to the images, and looks at none."""

    traits = MotionTraits(finds_motion=True)


@spoils("check_motion_momentum")
class Sluggish(Base):
    """Says that a body keeps half of its motion, and lets it keep all."""

    traits = MotionTraits(momentum=0.5)
