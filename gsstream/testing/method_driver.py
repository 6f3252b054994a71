"""Methods and frames as the subject of checks, on recordings of a few pixels.

A method is stepped in memory; parts that act inside a frame get the third frame of a tiny recording with some Gaussians
on the move.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from gsstream.core.changes import Scene
from gsstream.core.frame import Frame
from gsstream.core.log import FrameLog
from gsstream.core.part import Part
from gsstream.core.rng import Rng
from gsstream.discovery.catalog import load_catalog
from gsstream.engine.assembly.assemble import Assembly, assemble
from gsstream.engine.fit.photometric import FrameImages
from gsstream.engine.frame0.points import gather_points
from gsstream.engine.run.encoder import EncodedFrame, Encoder
from gsstream.engine.run.player_difference import difference_between
from gsstream.engine.step.context import EngineContext
from gsstream.input.recordings.open import open_source
from gsstream.method.base import StreamingMethod
from gsstream.metrics.picture_quality import psnr
from gsstream.packet import PlayerState, decode_packet
from gsstream.parts.backend.change import Change, find_change
from gsstream.player.render import named_renderer, render
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


#: Sigmas beyond which tiles count as changed.
THRESHOLD = 6.0
#: Index that the frame at work is given: none of those in which a chain is encoded.
INDEX = 7


class FitFixture(NamedTuple):
    """Arguments of a part: the decoded scene, the frame that it works on, random streams."""

    scene: Scene
    work: EngineContext
    rng: Rng


@functools.lru_cache(maxsize=1)
def _before() -> tuple[MethodUnderTest, EncodedFrame]:
    """A dense method, and its step of frame 1: some rows were displaced."""
    method = MethodUnderTest("dense")
    return method, method.chain()[1]


def fit_fixture(*, changed: bool = True) -> FitFixture:
    """Return frame 2 of a tiny recording, to be worked on; with ``changed`` false no tile counts as changed."""
    method, step = _before()
    state, frame = step.state, open_source(SOURCE).frame(2)
    before, now = (FrameImages(each.images, torch.device("cpu")).all_stored() for each in (state.previous, frame))
    change = find_change(before, now, THRESHOLD)
    if not changed:
        change = Change(torch.zeros_like(change.tiles), change.height, change.width)
    frame = replace(frame, index=INDEX, cameras=state.previous.cameras)
    view = EngineContext(assembly=method.assembly, state=state, frame=frame, log=FrameLog(), change=change)
    return FitFixture(state.player.scene, view, Rng(method.assembly.recipe.seed))


def method_with(slot: str, part: Part) -> MethodUnderTest:
    """Return a dense method that has this part in its slot; its frames are encoded when they are asked for."""
    method = MethodUnderTest("dense")
    changed: dict[str, Any] = {slot: part}
    method.assembly = replace(method.assembly, **changed)
    return method


def effect(slot: str, part: Part) -> str:
    """Return in words what a part does to a tiny recording: no promise, but a part that spoils it is seen."""
    test = open_source(SOURCE).frame(FRAMES - 1, "test")
    quality, kilobytes = [], []
    for method in (method_with(slot, part), MethodUnderTest("dense")):
        steps = method.chain()
        image = render(steps[-1].state.player.gaussians, test.cameras, renderer=named_renderer("numpy"))
        quality.append(psnr(np.clip(image, 0, 1), test.images[0]))
        kilobytes.append(np.mean([len(step.packet.data) for step in steps[1:]]) / 1e3)
    pixels = f"{test.cameras.width} x {test.cameras.height} pixels"
    return (
        f"frame {FRAMES - 1} of a recording of {pixels}, with it and without: {quality[0]:.1f} / {quality[1]:.1f} dB "
        f"in the test camera, {kilobytes[0]:.1f} / {kilobytes[1]:.1f} KB a frame"
    )


def check_closed_loop(slot: str, part: Part) -> None:
    """Raise AssertionError unless a player reaches the encoder's state bit by bit, and a second run its bytes."""
    method = method_with(slot, part)
    first = method.chain()
    check_replay(method, first)
    for one, other in zip(first, method.chain(), strict=True):
        assert one.packet.data == other.packet.data, f"frame {one.packet.frame}: a second run writes other bytes"
