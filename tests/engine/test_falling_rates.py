"""Learning rates of residuals that fall within a frame: by how much, in which table, and not unless a recipe asks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from flow_runs import WORLD, encode
from gsstream_cpu_render.renderer import CpuAdam
from gsstream_cpu_render.residual import CpuResidualOptimiser

from gsstream.engine.step.optimise import lr_factor
from gsstream.packet import StreamReader
from gsstream.parts.backend.adam import ReferenceAdam
from gsstream.parts.residual.adam_state import AdamState
from gsstream.parts.residual.optimiser import ResidualOptimiser
from gsstream.parts.residual.reference import JointResidualOptimiser
from gsstream.testing.optimiser import residual_case

FACTORS = (1.0, 0.5, 0.01)


def test_the_factor_falls_by_the_same_ratio_from_one_to_the_last() -> None:
    found = [lr_factor(0.01, iteration, 5) for iteration in range(5)]
    assert found == pytest.approx([1, 10**-0.5, 0.1, 10**-1.5, 0.01])
    assert found[0] == 1
    assert found[-1] == 0.01


def test_a_frame_of_one_iteration_has_the_full_rates() -> None:
    assert lr_factor(0.01, 0, 1) == 1


def test_a_final_factor_of_one_is_one_to_the_bit() -> None:
    assert {lr_factor(1.0, iteration, 540) for iteration in range(540)} == {1.0}


def trained(table: ResidualOptimiser, factors: Sequence[float | None]) -> bytes:
    """The bits of a table after a step with each factor; None: a step that is told nothing."""
    g = torch.Generator().manual_seed(5)
    for factor in factors:
        rows = table.forward(torch.rand(300, generator=g))
        table.backward(rows.map(lambda value: 1e-3 * torch.randn(value.shape, generator=g)), 1e-3)
        table.latents.grad = torch.full(table.latents.shape, 1e-4)
        _ = table.step() if factor is None else table.step(factor)
    return table.latents.detach().numpy().tobytes() + table.matrix.numpy().tobytes()


def joint(*case: Any) -> ResidualOptimiser:
    return JointResidualOptimiser(*case, ReferenceAdam())


def native(*case: Any) -> ResidualOptimiser:
    return CpuAdam().residual_optimiser(*case)


@pytest.mark.parametrize("make", [joint, native])
def test_a_factor_does_what_smaller_rates_do(make: Callable[..., ResidualOptimiser]) -> None:
    """Of latents and of decoders: a table whose rates are a quarter, and one that is told so in every step."""
    code, *rest = residual_case()
    slow = replace(code, lrs=0.25 * code.lrs, decoder_lrs=0.25 * code.decoder_lrs)
    assert trained(make(code, *rest), [0.25] * 3) == trained(make(slow, *rest), [None] * 3)
    assert trained(make(code, *rest), [1.0] * 3) == trained(make(code, *rest), [None] * 3)
    assert trained(make(code, *rest), FACTORS) != trained(make(code, *rest), [None] * 3)


def test_a_step_that_is_told_nothing_has_the_bits_of_the_optimiser_alone() -> None:
    """What a frame did before there was a factor: the optimiser's own step, with the rates of the code."""
    code, *rest = residual_case()
    table, optimiser = JointResidualOptimiser(code, *rest, ReferenceAdam()), ReferenceAdam()
    values = {"latents": table.latents.detach().clone(), "matrix": table.matrix.clone()}
    states = {name: AdamState.start(value, ahead=True) for name, value in values.items()}
    g = torch.Generator().manual_seed(6)
    for _ in range(3):
        rows = table.forward(torch.ones(300))
        table.backward(rows.map(lambda value: torch.randn(value.shape, generator=g)), 0.0)
        gradients = {"latents": table._grad.latents.clone(), "matrix": table._grad.matrix.clone()}
        optimiser.step(values, gradients, states, {"latents": code.lrs, "matrix": code.decoder_lrs})
        table.step(lr_factor(1.0, 1, 3))
        assert torch.equal(table.latents.detach(), values["latents"])
        assert torch.equal(table.matrix, values["matrix"])


class Heard:
    """The factors that the tables of a run were given, frame by frame."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.frames: list[list[float]] = []
        self.tables: set[str] = set()
        for kind in (JointResidualOptimiser, CpuResidualOptimiser):
            patch.setattr(kind, "__init__", self._opened(kind.__init__))
            patch.setattr(kind, "step", self._stepped(kind.step))

    def _opened(self, begin: Callable[..., None]) -> Callable[..., None]:
        def opened(table: ResidualOptimiser, *arguments: Any, **named: Any) -> None:
            self.frames.append([])
            begin(table, *arguments, **named)

        return opened

    def _stepped(self, step: Callable[..., None]) -> Callable[..., None]:
        def stepped(table: ResidualOptimiser, factor: float) -> None:
            self.frames[-1].append(factor)
            self.tables.add(type(table).__name__)
            step(table, factor)

        return stepped


def deltas(out: Path) -> list[bytes]:
    with StreamReader(out / "stream.gss") as reader:
        return [reader.read(entry) for entry in reader.frames[1:]]


@pytest.fixture(scope="module")
def first(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A frame 0 for all runs below."""
    out = tmp_path_factory.mktemp("first")
    encode(out, source=WORLD, frames=1)
    return str(out / "stream.gss")


@pytest.mark.parametrize(
    ("level", "table", "method", "epochs"),
    [
        ("off", "CpuResidualOptimiser", "dense", 1),
        ("off", "CpuResidualOptimiser", "s2gs-paper", 3),
        ("step", "JointResidualOptimiser", "s2gs-paper", 3),
    ],
)
def test_every_frame_of_a_run_falls_to_the_final_factor(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, first: str, level: str, table: str, method: str, epochs: int
) -> None:
    """With the short cuts and without; ``s2gs-paper`` trains progressively, and lets levels wait."""
    monkeypatch.setenv("GSSTREAM_CHECKS", level)
    heard = Heard(monkeypatch)
    more = {"source": WORLD, "method": method, "frames": 3, "stream__epochs": epochs, "first_frame__shell": False}
    encode(tmp_path / "out", "--first-frame", first, stream__lr_final_factor=0.01, **more)
    assert heard.tables == {table}
    iterations = 3 * epochs
    assert heard.frames == [[lr_factor(0.01, i, iterations) for i in range(iterations)]] * 2
    assert [frame[-1] for frame in heard.frames] == [0.01, 0.01]


def test_a_final_factor_of_one_changes_no_byte_of_what_follows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, first: str
) -> None:
    """Against a run whose tables are told nothing, as before there was a factor."""
    more = {"source": WORLD, "frames": 3}
    encode(tmp_path / "one", "--first-frame", first, stream__lr_final_factor=1, **more)
    step = CpuResidualOptimiser.step
    monkeypatch.setattr(CpuResidualOptimiser, "step", lambda table, factor: step(table))
    encode(tmp_path / "before", "--first-frame", first, **more)
    assert deltas(tmp_path / "one") == deltas(tmp_path / "before")
