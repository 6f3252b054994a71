"""A method as the subject of checks: its frames are stepped in memory, on a recording of 32 x 24 pixels."""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from gsstream.core.frame import Frame
from gsstream.core.rng import Rng
from gsstream.engine.assembly.assemble import Assembly, assemble
from gsstream.engine.frame0.begin import begin, begin_from
from gsstream.engine.step.frame_step import frame_step
from gsstream.engine.frame0.points import gather_points
from gsstream.engine.keys.resume import resume_state
from gsstream.engine.whole import WholeTools, begin_whole, resume_whole, step_whole
from gsstream.method.base import Step, StreamingMethod
from gsstream.packet import PlayerState, StreamMeta, decode_packet
from gsstream.plugins.catalog import load_catalog
from gsstream.recipe.load import resolve_recipe
from gsstream.recipe.model import ComponentRef
from gsstream.source.open import open_source

SOURCE = "synthetic:frames=4&views=3&width=32&height=24&supersample=1"
TINY = (
    "first_frame.max_iterations=8", "first_frame.max_points=200", "first_frame.fill_points=0", "stream.epochs=1",
    "first_frame.points=recording",
)  # fmt: skip
FRAMES = 3


class MethodUnderTest:
    """A method, made of parts or whole, with a tiny budget; frames are stepped in memory. Saboteurs override one call.
    """

    def __init__(self, name: str, whole: StreamingMethod[Any] | None = None) -> None:
        """Method ``name``; or a whole method under its recipe."""
        self.name = name
        catalog = load_catalog()
        overrides = [("the contract kit", text) for text in TINY]
        recipe = resolve_recipe(name, catalog.recipe_path, (), overrides).recipe
        if recipe.whole.name != "none":
            heeds = catalog.resolve("whole", recipe.whole.name).heeds
            overrides = [item for item in overrides if not item[1].startswith("stream.") or _key(item[1]) in heeds]
        self.parts: Assembly = assemble(resolve_recipe(name, catalog.recipe_path, (), overrides), catalog)
        if whole is not None:
            ref = ComponentRef(name="under-test", params=whole.config.model_dump(mode="json"))
            self.parts = replace(self.parts, whole=whole, recipe=self.parts.recipe.model_copy(update={"whole": ref}))
        self.seed = self.parts.recipe.seed

    def __repr__(self) -> str:
        return f"method {self.name}"

    @property
    def least_cameras(self) -> int:
        """How many training cameras it says it needs."""
        return 1 if self.parts.whole is None else self.parts.whole.least_cameras

    def tools(self, uri: str = SOURCE, first: PlayerState | None = None) -> WholeTools:
        """What the engine lends a whole method."""
        source = open_source(uri)
        info, recipe = source.info, self.parts.recipe

        def meta(frame: Frame) -> StreamMeta:
            return StreamMeta(
                recipe.method, info.name, recipe.model_dump(mode="json"), frame.cameras, info.test, info.fps,
                recipe.background, {},
            )  # fmt: skip

        return WholeTools(self.parts, source, Rng(self.seed), info.train.near, meta, first)

    def begin(self, frame: Frame, uri: str = SOURCE) -> Step[Any]:
        """Frame 0."""
        tools = self.tools(uri)
        if self.parts.whole is not None:
            return begin_whole(self.parts.whole, tools, frame)
        points = gather_points(tools.source, frame, self.parts.recipe.first_frame, tools.rng)
        return begin(self.parts, points, frame, tools.meta(frame), tools.rng, lambda *_: None)

    def take_over(self, first: PlayerState, frame: Frame) -> Step[Any]:
        """Frame 0 of another stream."""
        tools = self.tools(first=first)
        if self.parts.whole is not None:
            return begin_whole(self.parts.whole, tools, frame)
        return begin_from(self.parts, first, frame, tools.meta(frame), tools.rng)

    def step(self, state: Any, frame: Frame) -> Step[Any]:
        """A later frame."""
        if self.parts.whole is not None:
            return step_whole(self.parts.whole, self.tools(), state, frame)
        return frame_step(self.parts, state, frame, Rng(self.seed))

    def resume(self, stream: Path) -> Any:
        """The encoder's state after the last packet of a stream."""
        tools = self.tools()
        if self.parts.whole is not None:
            return resume_whole(self.parts.whole, tools, stream)
        return resume_state(self.parts, stream, tools.source, tools.rng, tools.near)

    def play(self, state: PlayerState | None, data: bytes) -> PlayerState:
        """What a player does with a packet."""
        return decode_packet(state, data)

    def chain(self, uri: str = SOURCE, choose: Callable[[Frame], Frame] | None = None) -> list[Step[Any]]:
        """All frames of a recording."""
        source = open_source(uri)
        frames = [source.frame(index) for index in range(FRAMES)]
        frames = [choose(frame) for frame in frames] if choose else frames
        steps = [self.begin(frames[0], uri)]
        for frame in frames[1:]:
            steps.append(self.step(steps[-1].state, frame))
        return steps

    @functools.cached_property
    def steps(self) -> list[Step[Any]]:
        """The chain that most checks look at, encoded once."""
        return self.chain()


@functools.lru_cache(maxsize=8)
def around(whole: StreamingMethod[Any]) -> MethodUnderTest:
    """A whole method as the subject of the checks of methods; its chain is encoded once."""
    return MethodUnderTest("dense", whole)


def _key(override: str) -> str:
    return override.partition("=")[0]
