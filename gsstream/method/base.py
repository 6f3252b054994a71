"""StreamingMethod: the one interface to a method. Its packets are played by every player.

A method is given a frame and what the engine can do (``Tools``), and returns a packet and the state it goes on from.
The engine keeps the rest: recordings, recipes, the stream on disk, metrics, resume. The method made of parts is
``engine.run.parts_method.PartsMethod``; QUEEN is another one, built differently.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any, ClassVar, Generic, Literal, Protocol, TypeVar, final

from gsstream.core.frame import Frame
from gsstream.core.part import Part
from gsstream.method.tools import Tools
from gsstream.packet import EncodedPacket, PlayerState, decode_packet

#: (state before or None, bytes of a packet) -> state after.
PacketDecoder = Callable[[PlayerState | None, bytes], PlayerState]


class MethodState(Protocol):
    """What a method carries from frame to frame. Frozen: a failed frame costs nothing.

    Whatever else it holds must follow from the packets sent so far, the images of the last frame that changed the scene
    and the recipe; then ``resume`` can make it again.
    """

    @property
    def player(self) -> PlayerState:
        """The state of every player after the last packet, bit by bit."""


State = TypeVar("State", bound=MethodState)


@dataclass(frozen=True)
class Step(Generic[State]):
    """Outcome of one frame: (state, frame) -> Step. Nothing is mutated, so a failed frame costs nothing.

    What the frame cost is written to ``tools.log``.

    Arguments:
        state: what the next frame starts from.
        packet: what is written.
        status: kind of the packet.
    """

    state: State
    packet: EncodedPacket
    status: Literal["key", "delta", "empty"]


class StreamingMethod(Part, Generic[State]):
    """A method. Pure: state goes in and comes out, random numbers come from ``tools.rng`` by name and frame.

    ``recipe_keys`` names the recipe keys that this method reads besides what the engine itself does (frame 0, loss,
    renderer, recording, packets), for example ``("stream.epochs",)``. A run that changes a key of the parts or of later
    frames that is not listed here is refused: no option is ignored in silence. A pattern names several:
    ``("stream.*",)``.
    ``min_cameras`` is how many training cameras it needs: a recording with fewer is refused before anything is
    reconstructed.
    """

    recipe_keys: ClassVar[tuple[str, ...]] = ()
    min_cameras: ClassVar[int] = 1

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "decoder" in vars(cls):
            raise TypeError(
                f"{cls.__name__}.decoder: every player decodes packets in the same way, so no method has a decoder of "
                "its own; take it out"
            )

    @final
    def reads(self, key: str) -> bool:
        """Return whether this method reads a recipe key: a slot ("gate"), or a setting ("stream.epochs")."""
        return any(fnmatchcase(key, pattern) for pattern in self.recipe_keys)

    @abstractmethod
    def begin(self, frame: Frame, tools: Tools) -> Step[State]:
        """Encode frame 0 as a key packet.

        ``tools.first_frame(frame)`` reconstructs the scene, for methods that need nothing of their own there.
        """

    @abstractmethod
    def step(self, state: State, frame: Frame, tools: Tools) -> Step[State]:
        """Encode a later frame as a delta, empty or key packet.

        ``state.player`` of the result must be ``decoder()(before.player, packet.data)``, bit for bit: the method goes
        on from what it sent, not from what it trained. The engine decodes every packet and compares. A frame whose
        ``epoch_scale`` is 0 is skipped: an empty packet, so that numbering and time go on; also one that failed, where
        the recipe says ``stream.on_error: repeat``.

        Arguments:
            state: what this method returned for the frame before, its ``follow_up`` included.
            frame: training images of this frame.
            tools: what the engine can do.
        """

    def follow_up(self, state: State, step: Step[State], frame: Frame, tools: Tools) -> Step[State]:
        """Do the work of a later frame that its packet need not wait for, and return the step with the state after it.

        The engine calls it once after every ``step``, when the packet has been handed out: live viewers do not wait for
        this work. The next frame begins after it. Packet, status and ``state.player`` stay as they are; the engine
        compares. ``resume`` must make the changes of this work to the state, too. By default there is no such work. A
        frame whose ``epoch_scale`` is 0 must not fail here either.

        Arguments:
            state: before the frame, as ``step`` was given it.
            step: what ``step`` returned for the frame.
            frame: training images of the frame.
            tools: what the engine can do.
        """
        return step

    @abstractmethod
    def resume(self, player: PlayerState, shown: Frame, tools: Tools) -> State:
        """Return the state after the last packet of a stream, as ``follow_up`` returned it there.

        Arguments:
            player: what every player has after that packet.
            shown: training images of the last frame whose packet was not empty: what the scene shows.
            tools: what the engine can do; ``since_key()`` replays the states of players since the last key packet.
        """

    @final
    def decoder(self) -> PacketDecoder:
        """Return the function from packets to scenes that every player has: no stream needs a plugin to play."""
        return decode_packet
