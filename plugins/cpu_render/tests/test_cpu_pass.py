"""Iterations of a residual in one native call: what the loop of single calls finds, whatever takes part in them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from gsstream_cpu_render.residual import CpuResidualOptimiser

from gsstream.core.errors import ComponentError
from gsstream.discovery.catalog import load_catalog
from gsstream.engine.assembly.assemble import Assembly, assemble
from gsstream.engine.budget.epoch_scheduler import EpochScheduler
from gsstream.engine.budget.plan import unlimited
from gsstream.engine.frame0.points import gather_points
from gsstream.engine.run.encoder import Encoder
from gsstream.engine.step import frame_step
from gsstream.engine.step.optimise import optimise
from gsstream.engine.step.problem import Problem, Solution
from gsstream.input.recordings.open import open_source
from gsstream.parts.gate.always_open import AlwaysOpen
from gsstream.parts.regularizer.base import AnalyticPenalty
from gsstream.parts.render.images import TILE
from gsstream.recipe.load import resolve_recipe

SOURCE = "synthetic:frames=3&views=3&width=64&height=48&supersample=1"
TINY = (
    "first_frame.max_iterations=20",
    "first_frame.points=recording",
    "first_frame.max_points=400",
    "stream.epochs=2",
)
#: Name of a case (what its iterations contain beside images, residuals, gates, their price and Adam) -> its settings.
CASES = {
    "edge: rates, rows that leave": ("s2gs-edge", ()),
    "levels that wait": ("s2gs-paper", ("gate.noise=none", "stream.epochs=4")),
    "position residuals that cost": ("s2gs-edge", ("regularizer.lambda2=3", "regularizer.lambda1=0.1")),
    "a sum instead of a mean": ("s2gs-edge", ("regularizer.reduction=sum", "regularizer.lambda1=1e-4")),
    "gates that are always open": ("dense", ()),
    "rates that fall": ("dense", ("stream.lr_final_factor=0.1",)),
    "colour maps of cameras": ("s2gs-edge", ("first_frame.exposure=true",)),
    "residuals without decoders": ("s2gs-edge", ("update=additive",)),
}


def captured(method: str, settings: tuple[str, ...]) -> tuple[Assembly, Problem]:
    """The parts and the problem of the last frame of a small run."""
    catalog, found = load_catalog(), []
    overrides = [("the test", text) for text in (*TINY, *settings)]
    parts = assemble(resolve_recipe(method, catalog.recipe_path, (), overrides), catalog)
    source = open_source(SOURCE)

    def noted(parts: Assembly, problem: Problem, schedule: EpochScheduler) -> Solution:
        found.append(problem)
        return optimise(parts, problem, schedule)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(frame_step, "optimise", noted)
        encoder = Encoder(parts, source.info, lambda frame: gather_points(source, frame, parts.recipe.first_frame))
        for index in range(3):
            encoder.encode(source.frame(index))
    problem = found[-1]
    # The run has committed the session of this frame already, so a new one is opened.
    session = parts.renderer.open(
        encoder.state.player.scene.gaussians.map(torch.from_numpy), None, source.frame(2).cameras, parts.background
    )
    session.narrow(problem.rows)
    return parts, replace(problem, session=session)


def solved(parts: Assembly, problem: Problem, schedule: EpochScheduler | None = None) -> Solution:
    problem.session.narrow(problem.rows)
    problem.generator.manual_seed(7)
    return optimise(parts, problem, schedule or EpochScheduler(unlimited(parts.recipe.stream), *counts(problem)))


def counts(problem: Problem) -> tuple[int, int]:
    return len(problem.cameras), len(problem.rows)


def one_by_one(parts: Assembly, problem: Problem, schedule: EpochScheduler | None = None) -> Solution:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CpuResidualOptimiser, "_native_run", lambda *_: [])
        return solved(parts, problem, schedule)


@pytest.fixture(autouse=True)
def calls(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many iterations each native call made; also in front of what is patched later."""
    made: list[int] = []
    run = CpuResidualOptimiser._native_run

    def counted(table: CpuResidualOptimiser, *given: Any) -> list[torch.Tensor]:
        losses = run(table, *given)
        made.append(len(losses))
        return losses

    monkeypatch.setattr(CpuResidualOptimiser, "_native_run", counted)
    return made


def assert_alike(one: Solution, other: Solution) -> None:
    assert torch.equal(one.rows, other.rows)
    assert one.iterations == other.iterations
    assert one.loss == pytest.approx(other.loss, rel=1e-5)
    np.testing.assert_allclose(one.logits.numpy(), other.logits.numpy(), rtol=0, atol=1e-3)
    for name, value in other.latents.items():
        largest = max(1e-6, float(value.abs().max()))
        np.testing.assert_allclose(one.latents[name].numpy(), value.numpy(), rtol=0, atol=2e-3 * largest, err_msg=name)
    for name, value in other.decoders.items():
        np.testing.assert_allclose(one.decoders[name].numpy(), value.numpy(), rtol=0, atol=1e-4, err_msg=name)


@pytest.mark.parametrize("case", CASES)
def test_one_call_finds_what_single_calls_find(case: str, calls: list[int]) -> None:
    parts, problem = captured(*CASES[case])
    calls.clear()
    found = solved(parts, problem)
    assert sum(calls) == found.iterations > 0, "every iteration was made by the native call"
    assert any(float(value.abs().max()) > 0 for value in found.latents.values())
    expected = one_by_one(parts, problem)
    assert_alike(found, expected)


def test_factors_of_tiles_count_in_one_call_as_in_single_calls() -> None:
    parts, problem = captured("s2gs-edge", ())
    rows, columns = (-(-side // TILE) for side in problem.target(0).image.shape[:2])
    factors = torch.rand(rows, columns, generator=torch.Generator().manual_seed(1)) * 3
    factors[0] = 0
    weighted = replace(problem, target=lambda view: replace(problem.target(view), tile_weights=factors))
    found = solved(parts, weighted)
    assert_alike(found, one_by_one(parts, weighted))
    assert found.loss != solved(parts, problem).loss


class FirstIteration(EpochScheduler):
    """Over after one iteration: the finer half of the levels has not had its turn."""

    def next_pass(self, order: Sequence[int]) -> Iterator[Sequence[int]]:
        yield order[:1]
        self.is_cut = True


@pytest.mark.parametrize("solve", [solved, one_by_one])
def test_nothing_moves_a_gate_whose_level_waits(solve: Callable[..., Solution], calls: list[int]) -> None:
    """Progressive training lets finer levels wait: neither images nor the price of openness reach their gates."""
    parts, problem = captured("s2gs-paper", ("gate.noise=none", "structure.grouping=gaussian", "propagation=group-max"))
    levels = torch.from_numpy(problem.layout.unit_of[problem.rows.numpy()].astype(np.int64))
    present = levels.unique()
    assert len(present) > 2, "a scene of several levels"
    calls.clear()
    found = solve(parts, problem, FirstIteration(unlimited(parts.recipe.stream), *counts(problem)))
    assert sum(calls) == (solve is solved), "the loop is the compiled one, or the one of single calls"
    moved = (found.logits != problem.logits)[problem.hierarchy.node_of[problem.rows]]
    waits = levels > present[len(present) // 2]
    assert not moved[waits].any()
    assert moved[~waits].all()


def test_open_gates_are_counted_after_every_epoch() -> None:
    """After each epoch as many gates are open as at the end of a frame of so many epochs."""
    parts, problem = captured("s2gs-paper", ("gate.noise=none",))

    def of_epochs(number: int) -> EpochScheduler:
        budget = replace(unlimited(parts.recipe.stream), epochs=number, rd_lambda=0.0)
        return EpochScheduler(budget, *counts(problem))

    found = solved(parts, problem, of_epochs(3))
    assert found.open_gates[0] > found.open_gates[-1] > 0
    present = problem.hierarchy.node_of[problem.rows].unique()
    final = parts.gate.sample(found.logits[present], None)
    assert found.open_gates[-1] == int((final > 0).sum())
    assert len(found.open_gates) == 3
    assert solved(parts, problem, of_epochs(1)).open_gates == found.open_gates[:1]


def faulty(change: Callable[[Problem], None], calls: list[int]) -> None:
    parts, problem = captured(*CASES["edge: rates, rows that leave"])
    problem = replace(problem, base=problem.base.map(torch.clone))
    change(problem)
    calls.clear()
    with pytest.raises(ComponentError) as native:
        solved(parts, problem)
    with pytest.raises(ComponentError) as loop:
        one_by_one(parts, problem)
    assert str(native.value) == str(loop.value)
    assert "iteration" in str(native.value)
    assert calls == [0], "nothing of the iteration was made"


@pytest.mark.parametrize("name", ["means", "sh0", "opacities"])
def test_a_value_that_is_not_finite_is_named_as_by_single_calls(name: str, calls: list[int]) -> None:
    def spoil(problem: Problem) -> None:
        getattr(problem.base, name)[3] = torch.nan

    faulty(spoil, calls)


def test_a_loss_that_is_not_finite_is_named_as_by_single_calls(calls: list[int]) -> None:
    def spoil(problem: Problem) -> None:
        problem.base.sh0[:] = 3e38

    faulty(spoil, calls)


def test_caches_that_do_not_fit_are_used_one_by_one(calls: list[int]) -> None:
    parts, problem = captured("s2gs-edge", ("renderer.name=cpu", "renderer.cache_mb=0.05"))
    calls.clear()
    found = solved(parts, problem)
    assert sum(calls) == 0
    assert_alike(found, one_by_one(parts, problem))


def test_a_time_budget_looks_at_its_clock_after_every_iteration(calls: list[int]) -> None:
    captured("s2gs-edge", ("budget.time=30", "stream.epochs=1"))
    assert calls
    assert set(calls) == {1}


def test_the_form_of_gates_that_are_always_open_is_one_everywhere() -> None:
    form = AlwaysOpen().form()
    gates, gate_grads = form.gates(torch.tensor([-9.0, 0.0, 9.0]))
    probability, probability_grads = form.probability(torch.tensor([-9.0, 0.0, 9.0]))
    assert torch.equal(gates, torch.ones(3))
    assert torch.equal(probability, torch.ones(3))
    assert not gate_grads.any()
    assert not probability_grads.any()
    assert AnalyticPenalty(0, 0).open_weight == 0
