"""Frame 0, later frames and motion stay on the device, and compute there what they compute on the processor.

The device is the pretend one, so this needs no GPU: one tensor of the processor in a loop, one value that is read, and
a test fails. The page of results shows the counts that are held here.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch
from gsstream_gsplat_render.fused import FusedLoss
from gsstream_gsplat_render.session import GsplatSession, Own
from resident import CPU, DEVICE, SAME_BITS, method_on

from gsstream.core.errors import ComponentError
from gsstream.core.frame import Frame
from gsstream.engine.frame0.optimise import FirstFrameRun
from gsstream.engine.step import frame_step
from gsstream.input.recordings.open import open_source
from gsstream.parts.backend.adam import ReferenceAdam
from gsstream.parts.motion.newton import DampedNewton
from gsstream.parts.render.loss import ReferenceLoss
from gsstream.parts.render.replay import Records
from gsstream.parts.residual.adam_state import AdamState
from gsstream.testing.method_driver import SOURCE
from gsstream.testing.pretend import PretendDevice

pytestmark = pytest.mark.skipif(
    torch.cuda.is_available(), reason="needs a process in which torch sees no GPU: set CUDA_VISIBLE_DEVICES= (empty)"
)
#: Large enough that some rows leave, and some tiles are touched by none of those that stay.
LARGER = "synthetic:frames=4&views=3&width=64&height=48&supersample=1"
COUNTS = Path(__file__).parents[3] / "docs" / "results" / "data" / "gpu.jsonl"


def on_the_page(what: str) -> dict[str, int]:
    """A row of the page of results."""
    rows = map(json.loads, COUNTS.read_text(encoding="utf-8").splitlines())
    found: dict[str, int] = next(row for row in rows if row["what"].startswith(what))
    return found


def crossings(what: str) -> tuple[int, ...]:
    """Copies up, copies down and waits."""
    row = on_the_page(what)
    return row["copies_up"], row["copies_down"], row["waits"]


RESIDENT = crossings("one iteration of a later frame")
MADE_ONCE = crossings("once a pass over the cameras of frame 0")
#: Of a whole later frame: its pictures and the decoded change go up, the solution comes down.
FRAME = crossings("a whole later frame")


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    source = open_source(SOURCE)
    return [source.frame(index) for index in range(3)]


def counted(log: PretendDevice, cls: type, name: str, patch: pytest.MonkeyPatch) -> list[tuple[int, ...]]:
    """What crosses from the beginning of one call of a function to that of the next, and the launches between."""
    marks: list[tuple[int, ...]] = []
    call: Callable[..., Any] = getattr(cls, name)

    def marked(self: Any, *args: Any, **kwargs: Any) -> Any:
        marks.append((*log.crossings, log.launches))
        return call(self, *args, **kwargs)

    patch.setattr(cls, name, marked)
    return marks


def between(marks: list[tuple[int, ...]]) -> list[tuple[int, ...]]:
    return [tuple(b - a for a, b in zip(one, other, strict=True)) for one, other in pairwise(marks)]


def replayed(log: PretendDevice, patch: pytest.MonkeyPatch) -> tuple[dict[str, list[tuple[int, ...]]], dict[str, int]]:
    """What has crossed when each replayed call begins, by name, and the operations of its largest record."""
    calls: dict[str, list[tuple[int, ...]]] = {}
    sizes: dict[str, int] = {}
    call, record = Records.call, Records._record

    def marked(self: Records, name: str, *args: Any, **kwargs: Any) -> Any:
        calls.setdefault(name, []).append((*log.crossings, log.launches))
        return call(self, name, *args, **kwargs)

    def measured(self: Records, name: str, *args: Any, **kwargs: Any) -> Any:
        made = record(self, name, *args, **kwargs)
        sizes[name] = max(sizes.get(name, 0), self.recorder.operations)
        return made

    patch.setattr(Records, "call", marked)
    patch.setattr(Records, "_record", measured)
    return calls, sizes


def packets_of(frames: list[Frame], device: torch.device = CPU, name: str = "s2gs-fast") -> list[bytes]:
    method = method_on(device, name)
    step = method.begin(frames[0])
    found = [step.packet.data]
    for frame in frames[1:]:
        step = method.step(step.state, frame)
        found.append(step.packet.data)
    return found


def test_an_iteration_of_frame_0_crosses_nothing(frames: list[Frame], monkeypatch: pytest.MonkeyPatch) -> None:
    """Between two densifications. What is made once for a view is made in the first passes."""
    views, method = len(frames[0].cameras), method_on(DEVICE)
    settings = method.assembly.recipe.first_frame.model_copy(update={"max_iterations": 6 * views})
    method.assembly = replace(
        method.assembly, recipe=method.assembly.recipe.model_copy(update={"first_frame": settings})
    )
    with PretendDevice() as log:
        marks = counted(log, FirstFrameRun, "step", monkeypatch)
        method.begin(frames[0])
    found = [crossed[:3] for crossed in between(marks)][3 * views - 1 :]
    assert len(found) == 3 * views
    for place, crossed in enumerate(found):
        # Before the first of a pass, losses and checks of the last one are read; the first brings its own dropout.
        limit = MADE_ONCE if place % views < 2 else RESIDENT
        assert all(map(int.__le__, crossed, limit)), (place, found, log.up, log.down, log.waits)
    assert found.count(RESIDENT) >= views


def test_a_later_frame_and_its_motion_stay_there_and_packets_are_those_of_the_processor(
    frames: list[Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    with PretendDevice() as log:
        method = method_on(DEVICE)
        step = method.begin(frames[0])
        packets = [step.packet.data]
        for frame in frames[1:]:
            calls, _ = replayed(log, monkeypatch)
            motion = counted(log, DampedNewton, "step", monkeypatch)
            before = log.crossings
            step = method.step(step.state, frame)
            crossed = tuple(b - a for a, b in zip(before, log.crossings, strict=True))
            assert between(iterations_of(calls))[-1][:3] == RESIDENT, (log.up, log.down, log.waits)
            assert between(motion)[-1][:3] == RESIDENT, (log.up, log.down, log.waits)
            assert all(map(int.__le__, crossed, FRAME)), (crossed, log.up, log.down, log.waits)
            packets.append(step.packet.data)
    assert packets == packets_of(frames)
    assert len(set(packets)) == len(frames)


def iterations_of(calls: dict[str, list[tuple[int, ...]]]) -> list[tuple[int, ...]]:
    """What had crossed when each iteration of the residual began."""
    return next(marks for name, marks in calls.items() if name.startswith("iterations"))


def test_the_counts_of_iterations_in_which_all_rows_take_part(
    frames: list[Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    with PretendDevice() as log:
        method = method_on(DEVICE)
        stream = method.assembly.recipe.stream.model_copy(update={"change_threshold": 0})
        method.assembly = replace(method.assembly, recipe=method.assembly.recipe.model_copy(update={"stream": stream}))
        step = method.begin(frames[0])
        calls, sizes = replayed(log, monkeypatch)
        method.step(step.state, frames[1])
        assert between(iterations_of(calls))[-1] == (
            *RESIDENT,
            on_the_page("one iteration of a later frame, all rows")["launches"],
        )
        for name, row in (
            ("iterations", "one iteration of a later frame, all rows"),
            ("gradients by", "one iteration of motion, all rows"),
        ):
            most = max(size for kind, size in sizes.items() if kind.startswith(name))
            assert 0 < most <= on_the_page(row)["operations"], (name, sizes)


def test_the_counts_of_a_narrowed_session_and_of_what_a_view_needs_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows leave after a pass: what is left of them is drawn into pictures of the others, which are made once."""
    source = open_source(LARGER)
    first, later = source.frame(0), source.frame(1)
    with PretendDevice() as log:
        method = method_on(DEVICE)
        settings = method.assembly.recipe.stream.model_copy(update={"epochs": 2})
        recipe = method.assembly.recipe.model_copy(update={"stream": settings})
        method.assembly = replace(method.assembly, recipe=recipe)
        step = method.begin(first)
        _, sizes = replayed(log, monkeypatch)
        drawn, own = [], GsplatSession.own

        def counted_own(self: GsplatSession, view: int) -> Own:
            before, is_first = log.launches, self.fixed is None and view not in self._tiles
            found = own(self, view)
            if is_first and found.shown is not None:
                drawn.append(log.launches - before)
            return found

        monkeypatch.setattr(GsplatSession, "own", counted_own)
        method.step(step.state, later)
    # The first call draws the pictures of all views, in which later ones only mark other tiles.
    once, again = on_the_page("pictures of all views"), on_the_page("the same, of a view that is drawn for the first")
    (pictures, *marked) = drawn
    assert marked, "no row has left"
    assert pictures <= once["operations"], drawn
    narrowed, motion = (
        on_the_page(f"one iteration of {what}, narrowed")["operations"] for what in ("a later frame", "motion")
    )
    assert max(size for name, size in sizes.items() if name.startswith("iterations")) <= narrowed, sizes
    assert max(size for name, size in sizes.items() if name.startswith("gradients by WrtTransforms")) <= motion, sizes
    assert narrowed + max(marked) <= again["operations"]


@SAME_BITS
@pytest.mark.parametrize("name", ["s2gs-paper", "dense", "hicom"])
def test_other_methods_write_the_packets_of_the_processor(frames: list[Frame], name: str) -> None:
    with PretendDevice():
        found = packets_of(frames[:2], DEVICE, name)
    assert found == packets_of(frames[:2], CPU, name)


def test_what_lies_on_the_processor_is_computed_as_the_reference_does() -> None:
    """A session returns what lies where its rows do, and kernels of a GPU cannot be given anything else."""
    renderer, g = method_on(DEVICE).assembly.renderer, torch.Generator().manual_seed(0)
    image, target = torch.rand(2, 20, 18, 3, generator=g).unbind()
    reference, loss = ReferenceLoss(), renderer.loss
    want, wanted = reference.evaluate(image, reference.prepare(target), 0.2)
    value, gradient = loss.evaluate(image, loss.prepare(target), 0.2)
    assert torch.equal(value, want)
    assert torch.equal(gradient, wanted)
    start, steps, gates = torch.rand(5, 3, generator=g), torch.ones(3), torch.ones(5)
    moved = []
    for optimiser in (renderer.optimiser, ReferenceAdam()):
        table, by_table = start.clone(), start.clone() + 1
        optimiser.add_rate(by_table, table, steps, gates, 0.1)
        optimiser.step({"t": table}, {"t": by_table}, {"t": AdamState.start(table)}, {"t": 0.1})
        moved.append(table)
    assert torch.equal(*moved)
    assert not torch.equal(moved[0], start)


def with_intruder(monkeypatch: pytest.MonkeyPatch, intruder: Callable[[torch.Tensor], torch.Tensor]) -> None:
    """Put one more line into the loss."""
    evaluate = FusedLoss.evaluate

    def intruding(self: FusedLoss, image: torch.Tensor, *args: Any) -> Any:
        value, gradient = evaluate(self, image, *args)
        return value, gradient + 0 * intruder(gradient)

    monkeypatch.setattr(FusedLoss, "evaluate", intruding)


def test_one_tensor_of_the_processor_is_refused(frames: list[Frame], monkeypatch: pytest.MonkeyPatch) -> None:
    with_intruder(monkeypatch, lambda gradient: torch.zeros(gradient.shape))
    with PretendDevice(), pytest.raises(ComponentError, match="expected tensors of one device"):
        method_on(DEVICE).begin(frames[0])


@pytest.mark.parametrize("intruder", [lambda t: torch.ones(t.shape).to(t.device), lambda t: t * float(t.sum())])
def test_one_copy_or_one_value_that_is_read_is_counted(
    frames: list[Frame], monkeypatch: pytest.MonkeyPatch, intruder: Callable[[torch.Tensor], torch.Tensor]
) -> None:
    with_intruder(monkeypatch, intruder)
    with PretendDevice() as log:
        marks = counted(log, FirstFrameRun, "step", monkeypatch)
        method_on(DEVICE).begin(frames[0])
    assert RESIDENT not in [crossed[:3] for crossed in between(marks)]


def test_where_little_changes_the_scene_stays_there_and_only_what_changed_crosses(
    frames: list[Frame], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(frame_step, "MOST_CHANGED", 1.0)  # of so few Gaussians, any change reaches more than half
    images = [frames[0].images.copy() for _ in range(2)]
    for place, image in enumerate(images):
        image[:, 4:10, 4 + 2 * place : 10 + 2 * place] = 0.1
    few = [frames[0], *(replace(frames[0], index=i + 1, images=image) for i, image in enumerate(images))]
    with PretendDevice() as log:
        method = method_on(DEVICE)
        step = method.begin(few[0])
        packets = [step.packet.data]
        for frame in few[1:]:
            before = log.up.copy()
            step = method.step(step.state, frame)
            packets.append(step.packet.data)
        # In the second such frame the scene, its groups and the images that it shows are there already.
        assert step.state.resident is not None
        crossed = log.up - before
        assert not [line for line in crossed if "step/context.py" in line or "core/hierarchy.py" in line], crossed
        assert sum(n for line, n in crossed.items() if "photometric.py" in line) == len(frames[0].cameras)
        scene = step.state.resident.gaussians.map(torch.Tensor.cpu)
    for (name, value), (_, want) in zip(scene.items(), step.state.player.gaussians.items(), strict=True):
        assert torch.equal(value, torch.from_numpy(want)), name
    assert packets == packets_of(few)
