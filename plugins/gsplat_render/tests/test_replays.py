"""What is recorded and replayed, on the pretend device, whose recorder refuses what a CUDA graph refuses."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import pytest
import torch
from gsstream_gsplat_render import rig as rig_module
from gsstream_gsplat_render.tiles import Grid
from resident import CPU, DEVICE, RIGS, SAME_BITS, method_on

from gsstream.core.deferred import deferred_checks, require
from gsstream.core.errors import ShapeError
from gsstream.core.frame import Frame
from gsstream.input.recordings.open import open_source
from gsstream.parts.gate.base import SampledGate
from gsstream.parts.render.replay import RecordError, Records
from gsstream.testing.method_driver import SOURCE
from gsstream.testing.pretend import PretendDevice, PretendRecorder

pytestmark = pytest.mark.skipif(
    torch.cuda.is_available(), reason="needs a process in which torch sees no GPU: set CUDA_VISIBLE_DEVICES= (empty)"
)


class Asked(NamedTuple):
    values: torch.Tensor
    factor: float


class Counting(PretendRecorder):
    def __init__(self) -> None:
        super().__init__()
        self.made = 0

    def record(self, work: Any, *, is_new: bool) -> Any:
        self.made += 1
        return super().record(work, is_new=is_new)


def on(*values: float) -> torch.Tensor:
    return torch.tensor(values).to(DEVICE)


def test_one_record_a_size_and_a_number_and_results_that_belong_to_the_caller() -> None:
    recorder = Counting()
    records = Records(recorder)
    with PretendDevice(), deferred_checks():
        first = records.call("double", lambda asked: asked.values * asked.factor, Asked(on(1, 2), 2.0))
        second = records.call("double", lambda asked: asked.values * asked.factor, Asked(on(3, 4), 2.0))
        assert recorder.made == 1
        records.call("double", lambda asked: asked.values * asked.factor, Asked(on(3, 4, 5), 2.0))
        records.call("double", lambda asked: asked.values * asked.factor, Asked(on(3, 4), 3.0))
        assert recorder.made == 3
        assert (first.cpu().tolist(), second.cpu().tolist()) == ([2, 4], [6, 8])


def test_what_is_changed_in_place_is_changed_once_a_call() -> None:
    records = Records(PretendRecorder())
    with PretendDevice(), deferred_checks():
        total, given = on(0, 0), on(1, 2)
        for place in range(3):
            records.call("add", lambda now: total.add_(now) * 1, given, [total])
            assert total.cpu().tolist() == [place + 1, 2 * (place + 1)]
            given = given.clone()
        given.add_(9)  # the same tensor with other values is copied again
        records.call("add", lambda now: total.add_(now) * 1, given, [total])
        assert total.cpu().tolist() == [13, 17]


def test_a_failed_check_is_raised_when_checks_are_read() -> None:
    records = Records(PretendRecorder())

    def half(now: torch.Tensor) -> torch.Tensor:
        require((now < 5).all(), lambda: ShapeError("now: expected less than 5"))
        return now / 2

    def halves() -> None:
        with deferred_checks():
            for value in (1.0, 7.0, 2.0):  # a later replay does not hide the failure
                records.call("half", half, on(value))

    with PretendDevice(), pytest.raises(ShapeError, match="less than 5"):
        halves()
    with PretendDevice(), deferred_checks():  # and it is forgotten once it was raised
        assert records.call("half", half, on(3.0)).cpu().tolist() == [1.5]


def test_what_reads_a_value_is_refused_once_and_changes_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    records = Records(PretendRecorder())
    with PretendDevice(), deferred_checks():
        total = on(1.0)
        assert records.can("reading")
        with pytest.raises(RecordError):
            records.call("reading", lambda now: total.add_(float(now.sum())), on(2.0), [total])
        assert total.cpu().tolist() == [1.0]
        assert not records.can("reading")
        assert records.can("other")
    assert capsys.readouterr().err.count("note: reading: queued one operation at a time") == 1


def test_nothing_is_recorded_within_a_record() -> None:
    recorder = PretendRecorder()
    records, inner = Records(recorder), Records(recorder)
    seen = []

    def outer(now: torch.Tensor) -> torch.Tensor:
        seen.append(inner.can("inner"))
        return now + 1

    with PretendDevice(), deferred_checks():
        records.call("outer", outer, on(1.0))
        assert inner.can("inner")
    assert seen
    assert not any(seen)


@pytest.fixture
def frames() -> list[Frame]:
    source = open_source(SOURCE)
    return [source.frame(index) for index in range(2)]


@pytest.fixture
def refused() -> Iterator[set[str]]:
    recorder = RIGS["pretend"].recorder
    assert recorder is not None
    kept = set(recorder.refused)
    yield recorder.refused
    recorder.refused.clear()
    recorder.refused.update(kept)


def packets(frames: list[Frame], device: torch.device, name: str = "s2gs-fast") -> list[bytes]:
    method = method_on(device, name)
    step = method.begin(frames[0])
    return [step.packet.data, method.step(step.state, frames[1]).packet.data]


def test_a_gate_that_reads_a_value_is_queued_and_gives_the_same_packets(
    frames: list[Frame], refused: set[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from gsstream.core.part import unwrapped

    gate = type(unwrapped(method_on(CPU).assembly.gate))
    sample = gate.sample

    def reading(self: Any, logits: torch.Tensor, noise: Any) -> torch.Tensor:
        assert float(logits.detach().sum()) > -1e9  # a third party's gate may look
        return sample(self, logits, noise)

    monkeypatch.setattr(gate, "sample", reading)
    monkeypatch.setattr(gate, "form", lambda _: SampledGate())
    with PretendDevice():
        found = packets(frames, DEVICE)
    assert f"iterations with {gate.__name__}" in refused
    assert "is not allowed meanwhile" in capsys.readouterr().err
    assert found == packets(frames, CPU)


@SAME_BITS
def test_a_pass_whose_lists_were_too_short_is_made_again(frames: list[Frame], monkeypatch: pytest.MonkeyPatch) -> None:
    grown = []
    grow = rig_module.Rig.grow

    def growing(self: rig_module.Rig) -> None:
        grown.append(int(self._grid.most) > self._grid.capacity)
        grow(self)

    with PretendDevice():
        method = method_on(DEVICE, "dense")  # without motion, whose pictures would be left out instead
        step = method.begin(frames[0])
        monkeypatch.setattr(rig_module, "LEAST", 1)
        monkeypatch.setattr(rig_module.Rig, "grow", growing)
        for rig in RIGS["pretend"]._last:
            rig._entries = 1  # as if a view of one entry was all that was ever seen
            rig._grid = Grid(*rig_module.tiles_of(rig.cameras), capacity=1, device=DEVICE)
        later = method.step(step.state, frames[1])
    assert grown == [True]
    assert [step.packet.data, later.packet.data] == packets(frames, CPU, "dense")
