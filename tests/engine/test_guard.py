"""Every function of every part is guarded: what it raises names slot, part, frame and iteration, and costs one frame.

One recording of five frames is encoded for each function; the part fails in it while frame 2 is made (which is a key
packet where the function is called for those alone). Then the same with ``stream.on_error: repeat``.
"""

from __future__ import annotations

import gc
import warnings
import weakref
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
import pytest
import torch
from bundle import Bundle

from gsstream.core.changes import AddedGaussians, RowEdit
from gsstream.core.errors import ComponentError
from gsstream.core.frame import Frame
from gsstream.core.part import unwrapped
from gsstream.encode import Encoder, encoder_for, open_recording
from gsstream.engine.assembly.guard import Guarded, guard
from gsstream.engine.assembly.part_in_use import Where
from gsstream.engine.run.run_frame import RepeatedFrameWarning
from gsstream.engine.step import frame_step as step_module
from gsstream.packet import decode_packet
from gsstream.parts.backend.adam import ReferenceAdam
from gsstream.parts.backend.reference import ReferenceRenderer
from gsstream.parts.backend.row_optimiser import RowOptimiser
from gsstream.parts.gate.always_open import AlwaysOpen
from gsstream.parts.gate.base import SampledGate
from gsstream.parts.growth.base import Growth
from gsstream.parts.render.session import RenderSession
from gsstream.testing.cases import rig, scene

WORLD = "synthetic:frames=5&views=2&width=32&height=24&supersample=1"
TINY = {
    "first_frame.max_iterations": 6,
    "first_frame.max_points": 120,
    "stream.epochs": 1,
    "first_frame.prune_error": 0,
}
BAD = 2

#: slot, function -> (whether frame 2 is made a key packet for it, whether it is called in iterations).
FUNCTIONS: dict[tuple[str, str], tuple[bool, bool]] = {
    ("structure", "build"): (True, False),
    ("confidence", "estimate"): (False, False),
    ("propagation", "propagate"): (False, False),
    ("gate", "num_levels"): (False, True),
    ("gate", "init"): (False, False),
    ("gate", "noise"): (False, True),
    ("gate", "sample"): (False, True),
    ("gate", "open_probability"): (False, False),
    ("gate", "bound"): (False, True),
    ("motion", "propose"): (False, False),
    ("update", "codes"): (False, False),
    ("update", "init_decoders"): (True, False),
    ("growth", "propose"): (False, False),
    ("regularizer", "penalty"): (False, True),
    ("renderer.loss", "evaluate"): (False, True),
    ("renderer.optimiser", "step"): (False, True),
    ("session", "render"): (False, True),
    ("session", "visible"): (False, False),
    ("session", "screen_gradient"): (False, False),
    ("session", "narrow"): (False, False),
    ("session", "commit"): (False, False),
    ("session", "cache_bytes"): (False, False),
}


class Failing:
    """A part that raises in one of its functions in one frame, and otherwise does what the sound one does.

    It states no closed form and has no residual optimiser of its own: a part that does is not called in the inner loop.
    """

    #: What is raised; a part may leave the process, too.
    error: type[BaseException] = RuntimeError

    def __init__(self, part: Any, function: str, where: Where, frame: int = BAD) -> None:
        self.__dict__.update(part=part, function=function, where=where, frame=frame)

    def __getattr__(self, name: str) -> Any:
        value = getattr(self.part, name)
        if name == "form":
            return SampledGate
        if name == "residual_optimiser":
            return partial(RowOptimiser.residual_optimiser, self)
        if name != self.function:
            return value
        if not callable(value):
            self.fail()
            return value

        def call(*args: Any, **kwargs: Any) -> Any:
            self.fail()
            return value(*args, **kwargs)

        return call

    def fail(self) -> None:
        if self.where.frame == self.frame:
            raise self.error("out of order")


class FailingSession(RenderSession):
    """The same for a session of a renderer, and for those that follow from it."""

    def __init__(self, session: RenderSession, failing: Failing) -> None:
        self.session, self.failing = session, failing

    def _call(self, name: str, *args: Any, **kwargs: Any) -> Any:
        if name == self.failing.function:
            self.failing.fail()
        return getattr(self.session, name)(*args, **kwargs)

    @property
    def cameras(self) -> Any:
        return self.session.cameras

    def render(self, *args: Any, **kwargs: Any) -> Any:
        return self._call("render", *args, **kwargs)

    def visible(self, *args: Any) -> Any:
        return self._call("visible", *args)

    def screen_gradient(self, *args: Any) -> Any:
        return self._call("screen_gradient", *args)

    def narrow(self, *args: Any) -> Any:
        return self._call("narrow", *args)

    def commit(self, *args: Any) -> Any:
        return FailingSession(self._call("commit", *args), self.failing)

    def cache_bytes(self) -> Any:
        return self._call("cache_bytes")


class FailingRenderer(Failing):
    """Its sessions fail; they are no others than those that the reference optimiser knows."""

    optimiser = ReferenceAdam()

    def open(self, *args: Any) -> Any:
        return FailingSession(self.part.open(*args), self)


@cache
def frames() -> tuple[Frame, ...]:
    with open_recording(WORLD) as source:
        return tuple(source.frame(index) for index in range(5))


def encoder(slot: str, make: Callable[[Any, Where], Any], **settings: Any) -> Encoder:
    """An encoder in which the part of one slot is replaced."""
    with open_recording(WORLD) as source:
        made = encoder_for("s2gs-edge", source, {**TINY, **settings})
    slot, _, member = slot.partition(".")
    part = made.assembly.part(slot)
    if member:  # of the reference, which calls its loss and its optimiser one at a time
        part = ReferenceRenderer()
        made_part: Any = Bundle(part, **{member: make(getattr(part, member), made.assembly.where)})
    else:
        made_part = make(part, made.assembly.where)
    made.assembly = replace(made.assembly, **{slot: made_part})
    return made


def spoiled(slot: str, function: str, **settings: Any) -> Encoder:
    key, _ = FUNCTIONS[slot, function]
    if key:
        settings["codec.key_interval"] = BAD
    if slot == "session":
        return encoder("renderer", lambda part, where: FailingRenderer(part, function, where), **settings)
    return encoder(slot, lambda part, where: Failing(part, function, where), **settings)


@pytest.fixture(autouse=True)
def few_candidates(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten rows take part in a frame: so few that a session is narrowed, and kept for the next frame."""
    found = step_module.candidates
    monkeypatch.setattr(step_module, "candidates", lambda *args: found(*args)[:10])


@pytest.mark.parametrize(("slot", "function"), FUNCTIONS)
def test_what_a_function_raises_is_said_with_its_place_and_costs_one_frame(slot: str, function: str) -> None:
    """It ends the run, which may go on from there; with ``repeat`` the same frame is an empty packet."""
    made, player, steps = spoiled(slot, function), None, []
    key, iterates = FUNCTIONS[slot, function]
    for frame in frames():
        if frame.index == BAD:
            before = made.state
            with pytest.raises(ComponentError, match="RuntimeError: out of order") as caught:
                made.encode(frame)
            error = caught.value
            assert error.slot == ("renderer" if slot == "session" else slot)
            assert error.part == ("FailingRenderer" if slot == "session" else "Failing")
            assert error.frame == BAD
            assert (error.iteration is not None) == iterates
            assert made.state is before
            stream = made.assembly.recipe.stream.model_copy(update={"on_error": "repeat"})
            made.assembly = replace(made.assembly, recipe=made.assembly.recipe.model_copy(update={"stream": stream}))
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always", RepeatedFrameWarning)
            steps.append(made.encode(frame))
        assert sum(one.category is RepeatedFrameWarning for one in said) == (frame.index == BAD), said
        player = decode_packet(player, steps[-1].packet.data)
        assert player.gaussians.means.tobytes() == made.state.player.gaussians.means.tobytes()
    assert steps[BAD].status == "empty"
    assert "RuntimeError: out of order" in steps[BAD].metrics["error"]
    assert steps[BAD].metrics["seconds"]["failed"] >= 0
    # A key packet that could not be made stays due.
    assert [step.status for step in steps[BAD + 1 :]] == (["key", "delta"] if key else ["delta", "delta"])


@pytest.mark.parametrize(("slot", "function"), [*FUNCTIONS][::4])
def test_a_part_that_leaves_the_process_fails_like_any_other(
    slot: str, function: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Failing, "error", SystemExit)
    made = spoiled(slot, function)
    for frame in frames()[:BAD]:
        made.encode(frame)
    with pytest.raises(ComponentError, match="SystemExit: out of order"):
        made.encode(frames()[BAD])


def test_numbers_of_another_precision_are_the_failure_of_the_part_that_returned_them() -> None:
    class Precise(Failing):
        def __getattr__(self, name: str) -> Any:
            value = getattr(self.part, name)
            return (lambda *args: value(*args).double()) if name == "estimate" else value

    made = encoder("confidence", lambda part, where: Precise(part, "estimate", where))
    made.encode(frames()[0])
    with pytest.raises(
        ComponentError, match=r"estimate\(\): expected a tensor of torch.float32, got torch.float64"
    ) as it:
        made.encode(frames()[1])
    assert it.value.slot == "confidence"


def test_a_part_that_fails_in_frame_0_ends_there() -> None:
    called = (("structure", "seed"), ("structure", "build"), ("update", "init_decoders"), ("renderer.loss", "prepare"))
    for slot, function in called:
        made = encoder(
            slot, lambda part, where, name=function: Failing(part, name, where, 0), **{"stream.on_error": "repeat"}
        )
        with pytest.raises(ComponentError) as caught:
            made.encode(frames()[0])
        assert (caught.value.slot, caught.value.part, caught.value.frame) == (slot, "Failing", 0)
        assert made.state is None


class Odd(Growth):
    """Proposes what the test wants."""

    wanted: Callable[[Any], Any]

    def propose(self, after: Any, work: Any, rng: Any) -> Any:
        return type(self).wanted(after)


def _births(after: Any, **changes: Any) -> RowEdit:
    given = {"nodes": np.zeros(1, np.int64), "unit_of": np.zeros(1, np.uint8), "parents": np.zeros(0, np.int64)}
    return RowEdit(AddedGaussians(after.gaussians.rows(np.array([0])), **{**given, **changes}))


ODD = {
    "another type": (lambda after: [1, 2], "expected RowEdit or None, got list"),
    "a node that is not there": (
        lambda after: _births(after, nodes=np.array([10**6])),
        "added: expected nodes from 0 to",
    ),
    "a unit that is not there": (
        lambda after: _births(after, unit_of=np.array([200], np.uint8)),
        "expected units 0 to",
    ),
    "a row that is not there": (lambda after: RowEdit(None, np.array([10**6])), "removed: expected rows from 0 to"),
    "a number that is none": (
        lambda after: RowEdit(
            replace(
                _births(after).added,
                gaussians=after.gaussians.rows(np.array([0])).map(lambda v: np.full_like(v, np.nan)),
            )
        ),
        "added: means: expected finite values, got nan",
    ),
}


@pytest.mark.parametrize("what", ODD)
def test_growth_is_blamed_for_what_does_not_fit(what: str) -> None:
    """Packets refuse it too, but then nobody knows any more whose it was."""
    wanted, message = ODD[what]
    part = type("Grower", (Odd,), {"wanted": staticmethod(wanted)})()
    made = encoder("growth", lambda *_: part)
    made.encode(frames()[0])
    before = made.state
    with pytest.raises(ComponentError, match=message) as caught:
        made.encode(frames()[1])
    assert (caught.value.slot, caught.value.part, caught.value.frame) == ("growth", "Grower", 1)
    assert made.state is before


class TestGuard:
    def part(self) -> Any:
        return guard("gate", AlwaysOpen(), Where(), encoder("gate", lambda part, _: part).assembly.checks)

    def test_it_stands_in_the_parts_place(self) -> None:
        guarded = self.part()
        assert guarded == AlwaysOpen()
        assert guarded == self.part()
        assert hash(guarded) == hash(AlwaysOpen())
        assert repr(guarded) == repr(AlwaysOpen())
        assert guarded.config == AlwaysOpen().config
        assert guarded.num_levels == 1
        assert type(unwrapped(guarded)) is AlwaysOpen
        assert unwrapped(AlwaysOpen()) == AlwaysOpen()

    def test_nothing_is_guarded_twice(self) -> None:
        again = guard("gate", self.part(), Where(), self.part()._use.level)
        assert isinstance(again, Guarded)
        assert type(unwrapped(again)) is AlwaysOpen

    def test_a_session_goes_with_its_owner_and_not_when_the_collector_comes(self) -> None:
        renderer, cameras = encoder("gate", lambda part, _: part).assembly.renderer, rig()
        gc.disable()
        try:
            session = renderer.open(scene(torch.randn(9, 3)), None, cameras, (0.0, 0.0, 0.0))
            session.narrow(torch.arange(3))
            seen = weakref.ref(unwrapped(session))
            del session
            assert seen() is None, "it holds a render of every camera: a few frames of them are a gigabyte"
        finally:
            gc.enable()

    def test_what_a_part_lacks_it_lacks(self) -> None:
        assert not hasattr(self.part(), "no_such_thing")
        assert getattr(self.part(), "no_such_thing", 3) == 3

    def test_every_part_of_an_assembly_is_guarded_once(self) -> None:
        parts = encoder("gate", lambda part, _: part).assembly
        others = "streaming_method", "renderer"
        for slot in ("structure", "confidence", "gate", "motion", "growth", *others):
            assert isinstance(getattr(parts, slot), Guarded)
            assert not isinstance(parts.part(slot), Guarded)
        for member in (parts.renderer.loss, parts.renderer.optimiser):
            assert isinstance(member, Guarded)
            assert not isinstance(unwrapped(member), Guarded)
        with pytest.raises(ComponentError, match=r"propagation .* failed at frame None"):
            parts.propagation.propagate(torch.zeros(3), "no hierarchy")
