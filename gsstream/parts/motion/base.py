"""MotionPart: which Gaussians move in a frame before its residual is learned, and how."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar

from gsstream.core.changes import Delta, Field, Layout, Motion, Scene
from gsstream.core.part import Part, Traits
from gsstream.core.rng import Rng
from gsstream.parts.render.work import FitContext


@dataclass(frozen=True, slots=True)
class MotionTraits(Traits):
    """What a motion part claims.

    Arguments:
        finds_motion: fits motions to the images: two bodies that move by a pixel or two, each its own way, are found.
        momentum: share of its last displacement by which a body moves where the images say nothing about the body;
            0: the body stays; None: nothing is promised.
    """

    finds_motion: bool = False
    momentum: float | None = None


class MotionPart(Part):
    """Proposes the motions that a frame begins with.

    A motion is a change of the stream (``core.changes.Motion``, or ``core.changes.Field``): encoder and player apply it
    with the same function, and its prediction from the last frame is part of that function. So a part decides which
    groups move and what corrects the prediction; it never moves Gaussians itself. The residual of the frame is learned
    on the moved scene.
    """

    traits: ClassVar[MotionTraits] = MotionTraits()

    def claims(self) -> MotionTraits:
        return self.traits

    @abstractmethod
    def propose(self, scene: Scene, work: FitContext, rng: Rng, memory: Any = None) -> tuple[Motion | Field, ...]:
        """Return the motions of this frame, in the order in which they apply; none leaves the scene where it is.

        A field may follow them, as the last.

        Arguments:
            scene: the decoded scene of the frame before, with the displacement of its rows and the groups that the last
                motion named (numpy; do not change it).
            work: the frame: images, what changed, and rendering with some rows moving.
            rng: random streams by name and frame; draw from nothing else.
            memory: what :meth:`follow` returned for the last delta packet, or :meth:`across_key` for a key packet
                since; None before there is one.
        """

    def follow(self, memory: Any, frame: int, before: Layout, delta: Delta, rng: Rng) -> Any:
        """Return the state that this part keeps after a delta packet. By default a part has none.

        A key packet ends it. A resumed run calls this for every packet since the last key packet, so the result follows
        from the arguments alone; do not change ``memory``.

        Arguments:
            memory: what this returned for the delta packet before; at the first after a key packet, what
                :meth:`across_key` returned for that.
            frame: index of the frame.
            before: the layout that ``delta`` refers to.
            delta: what the packet changes, as every player decodes it.
            rng: random streams by name and frame; draw from nothing else.
        """
        return None

    def across_key(self, replaced: Scene, scene: Scene) -> Any:
        """Return the state that this part keeps after a key packet inside a stream. By default a part has none.

        A player that begins with the key packet does not have it: it may decide where a fit begins, never what a motion
        is predicted from. A resumed run calls this as well, so the result follows from the arguments alone.

        Arguments:
            replaced: the decoded scene of the frame before, with its displacement and groups; its rows are in another
                order, and some may be others.
            scene: that of the key packet, which has neither.
        """
        return None
