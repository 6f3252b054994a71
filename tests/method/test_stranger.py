"""A third party's whole method has budgets, key packets and resume by what ``Tools`` lends it, and by nothing else."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

import pytest
import torch
from pydantic import Field

from gsstream.api import (
    Delta,
    Frame,
    PartConfig,
    PlayerState,
    Residual,
    Sent,
    Step,
    StreamingMethod,
    Tools,
    WrtRows,
    send_delta,
    send_key,
)
from gsstream.encode import Encoder, encoder_for, open_recording
from gsstream.engine.run.session import run
from gsstream.input.recordings.base import Source
from gsstream.packet import StreamReader, decode_packet

WORLD = "synthetic:frames=7&views=3&width=32&height=24&supersample=1"
TINY = {
    "first_frame.max_iterations": 8,
    "first_frame.max_points": 200,
    "first_frame.prune_error": 0,
    "background": [0, 0, 0],
    "first_frame.shell": False,
    "first_frame.points": "recording",
    "stream.epochs": 2,
}


@dataclass(frozen=True)
class Carried:
    player: PlayerState


@final
class Stranger(StreamingMethod[Carried]):
    """Learns the colour of every Gaussian in as many epochs as there is time for, and sends what there is room for."""

    class Config(PartConfig):
        key_interval: int = Field(default=3, ge=1)
        step: float = Field(default=0.02, gt=0)

    recipe_keys = ("stream.epochs", "budget.*")

    def begin(self, frame: Frame, tools: Tools) -> Step[Carried]:
        first = tools.first_frame(frame)
        packet, player = send_key(first.gaussians, first.layout, first.meta, frame.index)
        return Step(Carried(player), packet, "key")

    def step(self, state: Carried, frame: Frame, tools: Tools) -> Step[Carried]:
        if frame.epoch_scale == 0:
            packet, player = send_delta(state.player, Delta())
            return Step(Carried(player), packet, "empty")
        packet, player = self._fitting(state.player, self._learned(state.player, frame, tools), tools)
        if frame.index % self.config.key_interval == 0:
            with tools.log.phase("key"):
                refused = tools.key_refusal(len(player.gaussians))
                tools.log.set(refused=refused)
                if refused is None:
                    packet, player = send_key(player.gaussians, player.layout, tools.meta(frame), frame.index)
                    return Step(Carried(player), packet, "key")
        return Step(Carried(player), packet, "delta" if "sh0" in packet.sizes else "empty")

    def _learned(self, player: PlayerState, frame: Frame, tools: Tools) -> torch.Tensor:
        work, budget, iterations, views = tools.open(player, frame, frame), tools.budget, 0, len(frame.cameras)
        change = torch.zeros_like(work.gaussians.sh0)
        with tools.log.phase("optimise"):
            while iterations < views * tools.epochs(frame):
                left = budget.seconds_left()
                if left is not None and left <= 0:
                    break
                rows = replace(work.gaussians, sh0=work.gaussians.sh0 + change)
                change -= 0.5 * self.config.step * work.loss_and_grad(iterations % views, WrtRows(rows)).grad.sh0.sign()
                iterations += 1
        tools.log.set(iterations=iterations)
        return change

    def _fitting(self, player: PlayerState, change: torch.Tensor, tools: Tools) -> Sent:
        step, most = self.config.step, tools.budget.max_bytes
        while True:
            symbols = torch.round(change[:, 0] / step).int().numpy()
            some = symbols.any(1)
            residual = Residual(some.astype("uint8"), 1, {"sh0": symbols[some]}, {"sh0": step})
            sent = send_delta(player, Delta((residual,)) if some.any() else Delta())
            if not some.any() or most is None or len(sent.packet.data) <= most:
                return sent
            step *= 1.5

    def resume(self, player: PlayerState, shown: Frame, tools: Tools) -> Carried:
        return Carried(player)


@dataclass(frozen=True)
class Row:
    """A budget, the frames that become key packets under it, and why the others that are due do not."""

    settings: dict[str, Any]
    keys: tuple[int, ...]
    refused: str = ""
    epochs: int = 2


#: Nothing hangs on how fast the machine is: there is time for everything, or for nothing.
ROWS = {
    "no budget": Row({}, (0, 3, 6)),
    "room for all": Row({"budget.size": "1MB", "budget.time": "1000s"}, (0, 3, 6), epochs=30),
    "few bytes": Row({"budget.size": "80B"}, (0,), "bytes where 80 are allowed"),
    "no time": Row({"budget.time": "0.000001s"}, (0,), "s are allowed for the frame", epochs=0),
    "colour maps of cameras": Row({"first_frame.exposure": True}, (0, 3, 6)),
}


@contextmanager
def encoder(row: Row) -> Iterator[tuple[Encoder, Source]]:
    with open_recording(WORLD) as source:
        yield encoder_for("dense", source, {**TINY, **row.settings}, streaming_method=Stranger()), source


def made(row: Row, out: Path, resume: bool = False) -> bytes:
    out.mkdir(exist_ok=True)
    with encoder(row) as (subject, source):
        run(subject.assembly, source, out, resume=resume, quiet=True, measure=False)
    return (out / "stream.gss").read_bytes()


@pytest.mark.parametrize("row", ROWS.values(), ids=ROWS)
def test_its_frames_keep_to_their_budget(row: Row) -> None:
    with encoder(row) as (subject, source):
        steps = [subject.encode(source.frame(index)) for index in range(7)]
    assert [step.packet.frame for step in steps if step.status == "key"] == list(row.keys)
    for step in steps[1:]:
        line, limits = step.metrics, row.settings.keys() & {"budget.size", "budget.time"}
        assert line["iterations"] == 3 * row.epochs
        assert ("budget" in line) == bool(limits)
        assert line.get("budget", {}).get("violated", []) == (["time"] if row.epochs == 0 else [])
        assert ("usage" in line.get("budget", {})) == bool(limits and row.epochs)
        if step.packet.frame % 3 == 0:
            assert row.refused in (line["refused"] or "")
            assert (line["refused"] is None) == (step.packet.frame in row.keys)
    assert any(step.status == "delta" for step in steps) == (row.epochs > 0)


@pytest.mark.parametrize("at", [3, 4])
@pytest.mark.parametrize("row", ROWS.values(), ids=ROWS)
def test_it_is_killed_and_resumed_to_the_same_bytes(
    row: Row, at: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, encode = made(row, tmp_path / "whole"), Encoder.encode

    def killed(self: Encoder, frame: Frame) -> Any:
        if frame.index == at:
            raise KeyboardInterrupt
        return encode(self, frame)

    with monkeypatch.context() as patch:
        patch.setattr(Encoder, "encode", killed)
        with pytest.raises(KeyboardInterrupt):
            made(row, tmp_path / "cut")
    assert (tmp_path / "cut" / "stream.gss").read_bytes() != whole
    assert made(row, tmp_path / "cut", resume=True) == whole


def test_a_later_key_packet_says_of_the_scene_what_the_first_says(tmp_path: Path) -> None:
    """Without the colour maps, what is rendered after it would be compared with images of other colours."""
    made(ROWS["colour maps of cameras"], tmp_path / "out")
    with StreamReader(tmp_path / "out" / "stream.gss") as reader:
        said = [decode_packet(None, reader.read(reader.frames[frame])).meta.extra for frame in (0, 3)]
    assert said[0]["exposure"] == said[1]["exposure"]
    assert said[0]["origin"] == said[1]["origin"]
