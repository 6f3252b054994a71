"""What the engine lends to a method. Protocols: the engine implements them, methods only call."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import torch

from gsstream.core.changes import Layout
from gsstream.core.gaussians import Gaussians
from gsstream.core.log import FrameLog
from gsstream.core.shapes import FloatArray
from gsstream.method.budget import FrameBudget
from gsstream.packet import PlayerState, StreamMeta
from gsstream.parts.render.work import FitContext

if TYPE_CHECKING:
    from gsstream.core.frame import Frame, PointCloud
    from gsstream.core.rng import Rng
    from gsstream.parts.backend.base import Renderer
    from gsstream.parts.render.session import RenderSession
    from gsstream.parts.render.target import ViewTarget


@dataclass(frozen=True)
class FirstFrame:
    """Frame 0 as the engine reconstructs it, or as another stream has it (``--first-frame``).

    Arguments:
        gaussians: the scene, with the values that a key packet holds.
        layout: one node per Gaussian and one unit; a method may send another.
        meta: what the key packet says about the run, colour maps of the training cameras included.
    """

    gaussians: Gaussians[FloatArray]
    layout: Layout
    meta: StreamMeta


class FrameTools(FitContext, Protocol):
    """One frame as a method works on it: what parts see of it, and the render session itself."""

    @property
    def session(self) -> RenderSession:
        """Opened on the scene of the frame before; ``narrow`` it to the rows that may change."""

    def on(self, gaussians: Gaussians[torch.Tensor]) -> FrameTools:
        """Return the same frame, to be worked on from another scene, which gets a session of its own.

        A session holds a render for every camera that was asked for, as long as something holds it.
        """

    def view_target(self, view: int, tile_weights: torch.Tensor | None = None) -> ViewTarget:
        """Return what renders of a view are compared with, for ``loss_and_grad`` of a session.

        Arguments:
            view: index of a training camera.
            tile_weights: [ceil(H / 16), ceil(W / 16)] float32 factors on the gradients of tiles; a tile of 0 is left
                out. None: all count once.
        """


class Tools(Protocol):
    """What a method may use, the one made of parts included. Only ``log`` is written to, and it ends with the frame."""

    @property
    def rng(self) -> Rng:
        """Random streams by name and frame; draw from nothing else."""

    @property
    def renderer(self) -> Renderer: ...

    @property
    def background(self) -> tuple[float, float, float]: ...

    @property
    def log(self) -> FrameLog:
        """The record of this frame: wrap work into ``log.phase(name)``, write numbers by ``log.set(...)``."""

    @property
    def first(self) -> PlayerState | None:
        """Frame 0 of another stream, to be taken over; None: frame 0 is to be reconstructed."""

    @property
    def budget(self) -> FrameBudget:
        """What this frame may cost; its limits are None where the recipe sets none, and in frame 0."""

    def epochs(self, frame: Frame) -> int:
        """Return how many epochs (iterations of every training camera) a later frame is worth.

        This is ``stream.epochs`` (list it in ``recipe_keys``), or less when a budget or a live run allows less.
        """

    def points(self, frame: Frame) -> PointCloud:
        """Return the seeds of frame 0, made from its training images or from the scene that is taken over."""

    def progress(self, iteration: int, iterations: int, loss: float, gaussians: int) -> None:
        """Show how far the optimisation of frame 0 is."""

    def meta(self, frame: Frame) -> StreamMeta:
        """Return the meta of a key packet of this frame: the run, and the scene that players have before it."""

    def key_refusal(self, num_gaussians: int) -> str | None:
        """Return why a later key packet of so many Gaussians does not fit the budget now; None: it may be sent."""

    def first_frame(self, frame: Frame) -> FirstFrame:
        """Reconstruct frame 0 by the recipe's ``first_frame``, or take it over from another stream."""

    def recorded(self, index: int) -> Frame:
        """Return the training images of an earlier frame while a stream is resumed. Raises InputError otherwise."""

    def since_key(self) -> Iterator[PlayerState]:
        """Yield, in a resumed run, the players' state after each packet since the last key packet, in order."""

    def open(self, player: PlayerState, previous: Frame, frame: Frame) -> FrameTools:
        """Begin work on a frame.

        Arguments:
            player: what every player has before it.
            previous: the images that this scene shows.
            frame: training images of the frame.
        """
