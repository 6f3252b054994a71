"""What the engine lends to a method. Protocols: the engine implements them, methods only call."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import torch

from gsstream.core.changes import Layout
from gsstream.core.gaussians import Gaussians
from gsstream.core.shapes import FloatArray
from gsstream.packet import PlayerState, StreamMeta
from gsstream.render.work import FrameWork

if TYPE_CHECKING:
    from gsstream.core.frame import Frame
    from gsstream.core.rng import Rng
    from gsstream.render.base import Renderer, RenderSession
    from gsstream.render.target import ViewTarget


@dataclass(frozen=True)
class FirstFrame:
    """Frame 0 as the engine reconstructs it, or as another stream has it (``--first-frame``).

    Arguments:
        gaussians: the scene, with the values that a key packet holds.
        layout: one node per Gaussian and one unit; a method may send another.
        meta: what the key packet says about the run, colour maps of the training cameras included.
        metrics: iterations and seconds.
    """

    gaussians: Gaussians[FloatArray]
    layout: Layout
    meta: StreamMeta
    metrics: Mapping[str, Any]


class FrameTools(FrameWork, Protocol):
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
    """What a method may use. Nothing here keeps state between frames."""

    @property
    def rng(self) -> Rng:
        """Random streams by name and frame; draw from nothing else."""

    @property
    def renderer(self) -> Renderer: ...

    @property
    def background(self) -> tuple[float, float, float]: ...

    def epochs(self, frame: Frame) -> int:
        """Return how many passes over the training cameras a later frame is worth.

        This is ``stream.epochs`` (list it in ``heeds``), or less when a live run has fallen behind.
        """

    def first_frame(self, frame: Frame) -> FirstFrame:
        """Reconstruct frame 0 by the recipe's ``first_frame``, or take it over from another stream."""

    def since_key(self) -> Iterator[PlayerState]:
        """Yield, while a stream is resumed, what players have after every packet from the last key packet on, in order.
        """

    def open(self, player: PlayerState, previous: Frame, frame: Frame) -> FrameTools:
        """Begin work on a frame.

        Arguments:
            player: what every player has before it.
            previous: the images that this scene shows.
            frame: training images of the frame.
        """
