"""A method as the subject of checks: its frames are stepped in memory, on a recording of 32 x 24 pixels."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from gsstream.core.frame import Frame
from gsstream.discovery.catalog import load_catalog
from gsstream.engine.assembly.assemble import Assembly, assemble
from gsstream.engine.frame0.points import gather_points
from gsstream.engine.run.encoder import EncodedFrame, Encoder
from gsstream.engine.run.player_difference import difference_between
from gsstream.input.recordings.open import open_source
from gsstream.method.base import StreamingMethod
from gsstream.packet import PlayerState, decode_packet
from gsstream.recipe.load import resolve_recipe
from gsstream.recipe.model import ComponentRef

SOURCE = "synthetic:frames=4&views=3&width=32&height=24&supersample=1"
TINY = (
    "first_frame.max_iterations=8",
    "first_frame.max_points=200",
    "stream.epochs=1",
    # Pictures of so few pixels would miss so few Gaussians that a method had nothing to do.
    "first_frame.prune_error=0",
    "first_frame.points=recording",
    # The analytic scene stands before black; in eight iterations, a shell would be most of what is seen.
    "background=[0,0,0]",
    "first_frame.shell=false",
)
FRAMES = 3


class MethodUnderTest:
    """A method with a tiny budget; frames are stepped in memory. Saboteurs override one call."""

    def __init__(self, name: str, method: StreamingMethod[Any] | None = None) -> None:
        """Take the method ``name``; or ``method`` under the recipe of that name."""
        self.name = name
        catalog = load_catalog()
        recipe = resolve_recipe(name, catalog.recipe_path, (), [("the contract kit", text) for text in TINY]).recipe
        reads = catalog.resolve("streaming_method", recipe.streaming_method.name)().reads
        # Without a residual nothing reads how many passes it gets.
        learns = bool(catalog.resolve("update", recipe.update.name)().codes())
        kept = [text for text in TINY if not text.startswith("stream.") or (learns and reads(text.partition("=")[0]))]
        overrides = [("the contract kit", text) for text in kept]
        self.assembly: Assembly = assemble(resolve_recipe(name, catalog.recipe_path, (), overrides), catalog)
        if method is not None:
            ref = ComponentRef(name="under-test", params=method.config.model_dump(mode="json"))
            recipe = self.assembly.recipe.model_copy(update={"streaming_method": ref})
            self.assembly = replace(self.assembly, streaming_method=method, recipe=recipe)

    def __repr__(self) -> str:
        return f"method {self.name}"

    @property
    def min_cameras(self) -> int:
        """How many training cameras it says it needs."""
        return self.assembly.streaming_method.min_cameras

    def encoder(self, uri: str = SOURCE, first: PlayerState | None = None) -> Encoder:
        """Return an encoder of this method, before frame 0."""
        source = open_source(uri)
        settings, assembly = self.assembly.recipe.first_frame, self.assembly
        encoder = Encoder(
            assembly,
            source.info,
            lambda frame: gather_points(source, frame, settings),
            first_frame=first,
        )
        return encoder

    def begin(self, frame: Frame, uri: str = SOURCE) -> EncodedFrame:
        """Make frame 0."""
        return self.encoder(uri).encode(frame)

    def take_over(self, first: PlayerState, frame: Frame) -> EncodedFrame:
        """Make frame 0 from that of another stream."""
        return self.encoder(first=first).encode(frame)

    def step(self, state: Any, frame: Frame) -> EncodedFrame:
        """Make a later frame."""
        encoder = self.encoder()
        encoder.state = state
        return encoder.encode(frame)

    def resume(self, stream: Path) -> Any:
        """Return the encoder's state after the last packet of a stream."""
        source, encoder = open_source(SOURCE), self.encoder()
        encoder.resume(stream, source.frame)
        return encoder.state

    def play(self, state: PlayerState | None, data: bytes) -> PlayerState:
        """Return the player's state after a packet."""
        return decode_packet(state, data)

    def chain(self, uri: str = SOURCE, choose: Callable[[Frame], Frame] | None = None) -> list[EncodedFrame]:
        """Make all frames of a recording."""
        source = open_source(uri)
        frames = [source.frame(index) for index in range(FRAMES)]
        frames = [choose(frame) for frame in frames] if choose else frames
        steps = [self.begin(frames[0], uri)]
        for frame in frames[1:]:
            steps.append(self.step(steps[-1].state, frame))
        return steps

    @functools.cached_property
    def steps(self) -> list[EncodedFrame]:
        """The chain that most checks look at, encoded once."""
        return self.chain()


def check_replay(method: MethodUnderTest, steps: Sequence[EncodedFrame]) -> None:
    """Raise AssertionError unless a player that is given the packets alone has the state of every step, bit by bit.

    Compared are the Gaussians, their layout, decoders, and the displacement and groups that later motions start from.
    """
    player: PlayerState | None = None
    for step in steps:
        player = method.play(player, step.packet.data)
        difference = difference_between(player, step.state.player)
        assert not difference, f"frame {player.frame}: expected the encoder's state after the packet, got {difference}"


@functools.lru_cache(maxsize=8)
def around(method: StreamingMethod[Any]) -> MethodUnderTest:
    """Return a method as the subject of the checks of methods; its chain is encoded once."""
    return MethodUnderTest("dense", method)
