"""Optimise one frame's gates and residuals. Only candidates take part.

:func:`optimise` makes passes over the training cameras. What it does with the views of a pass is
``ResidualOptimiser.run``, whose body is this::

    for view, target, frozen, lr_factor in iterations:
        gates = trained_gates.sample(frozen)                    # noise, where the gate part has some
        rows = base + gates * (latents @ decoders)              # forward: the residual behind its gates
        loss, d_rows = session.loss_and_grad(view, target, rows)    # render, compare, differentiate
        d_gates = backward(d_rows, rd_lambda)                   # to latents, decoders and gates; bits have a price
        trained_gates.step(gates, d_gates, frozen)              # and the penalty on open gates
        adam.step(latents, decoders, lr_factor)

On a processor the compiled backend runs the same iterations in one call, in C++
(``plugins/cpu_render/src/cpp/fit/residual_pass.cpp``), where it knows the gate and the penalty in closed form.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial

import numpy as np
import torch

from gsstream.core.deferred import deferred_checks
from gsstream.core.picture_size import bit_price_factor
from gsstream.core.shapes import IntArray
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.assembly.checks import Checks
from gsstream.engine.budget.epoch_scheduler import EpochScheduler, estimated_bytes
from gsstream.engine.fit.constants import GATE_LR
from gsstream.engine.fit.gates import TrainedGates
from gsstream.engine.step.problem import Problem, Solution
from gsstream.parts.gate.base import GateSampler
from gsstream.parts.residual.layout import joint_layout
from gsstream.parts.residual.optimiser import Iteration, ResidualEpoch
from gsstream.parts.update.base import init_latents
from gsstream.recipe.model import Stream

#: Rows leave only when at least half of them can: each time, every view has to be frozen anew.
MAX_RETAINED_SHARE = 0.5


def optimise(assembly: Assembly, problem: Problem, schedule: EpochScheduler) -> Solution:
    """Minimise photometric loss + penalty + rate over the passes of the schedule, one view per iteration."""
    if len(problem.rows) == 0:
        return Solution(problem.rows.cpu(), {}, {}, problem.logits.cpu())
    fit, losses = _Fit(assembly, problem, schedule), list[torch.Tensor]()
    while schedule.goes_on and len(fit.rows):
        order = torch.randperm(len(problem.cameras), generator=problem.generator).tolist()
        losses = [loss for views in schedule.next_pass(order) for loss in fit.run(views)]
        if not schedule.is_cut:
            fit.end_pass()
    return fit.solution(losses)


class _Fit:
    """The moving state of one frame's optimisation; lives only inside :func:`optimise`."""

    def __init__(self, assembly: Assembly, problem: Problem, schedule: EpochScheduler) -> None:
        self.assembly, self.problem, self.schedule, self.rows = assembly, problem, schedule, problem.rows
        layout, index, device = problem.layout, problem.rows.cpu().numpy(), problem.rows.device
        self.levels = torch.from_numpy(layout.unit_of[index].astype("int64")).to(device)
        self.stages = level_schedule(assembly.recipe.stream, layout.unit_of)
        latents = init_latents(problem.codes, problem.base)
        self.decoders = {name: problem.decoders[name].to(device) for name in latents if name in problem.decoders}
        self.code = joint_layout(problem.codes, latents, self.decoders, problem.base)
        units, matrix = torch.from_numpy(layout.units_of(index)).to(device), self.code.join_decoders(self.decoders)
        self.residual = assembly.renderer.optimiser.residual_optimiser(self.code, problem.base, units, matrix)
        self.gates = TrainedGates(
            gate=assembly.gate,
            regularizer=assembly.regularizer,
            optimiser=assembly.renderer.optimiser,
            lr=GATE_LR,
            logits=problem.logits,
            hierarchy=problem.hierarchy,
            rows=problem.rows,
            generator=problem.generator,
        )
        self.iterations, self.open_gates = 0, list[int]()

    def run(self, views: Sequence[int]) -> list[torch.Tensor]:
        """Make one iteration on each of these views; return the photometric losses."""
        cameras, final, first = self.problem.cameras, self.assembly.recipe.stream.lr_final_factor, self.iterations
        total, pixels = self.schedule.epochs * len(cameras), cameras.width * cameras.height
        iterations = [
            Iteration(view, self.problem.target(view), self.frozen(number / total), lr_factor(final, number, total))
            for number, view in enumerate(views, first)
        ]
        price = self.schedule.rd_lambda * bit_price_factor(pixels) / pixels
        begin = partial(self.assembly.where.iterate, first)
        self.gates.draw_ahead(len(iterations))
        self.iterations += len(iterations)
        with deferred_checks(self.assembly.checks is not Checks.STEP):
            return self.residual.run(
                ResidualEpoch(
                    session=self.problem.session, iterations=iterations, gates=self.gates, rd_lambda=price, begin=begin
                )
            )

    def end_pass(self) -> None:
        """Let go of rows whose gate has closed, but where the recipe lets everything take part; weigh the bytes."""
        opened = self.gates.opened()
        self.open_gates.append(int(opened.sum()))
        if self.schedule.budget.change_threshold > 0 and self.schedule.goes_on:
            self.release(opened, self.frozen(self.schedule.done / self.schedule.epochs))
        if self.schedule.sized and len(self.rows):
            self.schedule.weigh_bytes(self.estimated_bytes())

    def frozen(self, fraction: float) -> torch.Tensor | None:
        """[A] bool: rows whose level is not trained yet at this share of the frame; None: all take part."""
        return self.levels > current_level(self.stages, fraction) if self.stages else None

    def release(self, opened: torch.Tensor, frozen: torch.Tensor | None) -> None:
        """Let go of the rows whose gate has closed: they no longer cost anything in this frame.

        A closed gate draws its rows as they were, so nothing that is seen changes.
        """
        keep = opened[self.gates.node_of] if frozen is None else opened[self.gates.node_of] | frozen
        if int(keep.sum()) > MAX_RETAINED_SHARE * len(keep):
            return
        rows = keep.nonzero()[:, 0]
        self.gates.select_rows(rows)
        self.residual.select_rows(rows)
        self.rows, self.levels = self.rows[rows], self.levels[rows]
        self.problem.session.narrow(self.rows)

    def estimated_bytes(self) -> float:
        """Bytes of a packet if this epoch were the last: symbols behind open gates, and the gates."""
        opened = self.gates.opened()
        latents = self.residual.latents.detach()[opened[self.gates.node_of]]
        return estimated_bytes(torch.round(latents / self.code.steps)) + float(opened.sum())

    def solution(self, losses: Sequence[torch.Tensor]) -> Solution:
        """What was found, and the mean of these losses."""
        dead = count_dead_gates(self.assembly.gate, self.gates.logits)
        self.assembly.where.pause()
        return Solution(
            rows=self.rows.cpu(),
            latents=self.code.split(self.residual.latents.detach().cpu()),
            decoders=self.code.split_decoders(self.residual.matrix.cpu(), self.decoders),
            logits=self.gates.all_logits().cpu(),
            loss=sum(torch.stack(list(losses)).cpu().tolist()) / len(losses),
            iterations=self.iterations,
            curvature=self.code.split(self.residual.curvature.cpu()),
            dead_gates=dead,
            open_gates=self.open_gates,
        )


def lr_factor(final: float, iteration: int, iterations: int) -> float:
    """Return the factor on the learning rates of a frame's residual at an iteration: it falls exponentially from 1."""
    return math.pow(final, iteration / max(1, iterations - 1))


#: Iterations of a level in multiples of those of the level before, N_{i+1} = omega N_i: the paper leaves omega open.
OMEGA = 1.5


def level_schedule(stream: Stream, unit_of: IntArray) -> tuple[tuple[float, int], ...]:
    """Return pairs (fraction of the frame until which, finest level that takes part) (paper, supplement).

    The H levels are those that hold Gaussians: a structure may have more, of which the finest are often empty, and a
    schedule over empty levels would delay no row. It starts at level floor(H / 2); each finer level's stage is
    omega times longer, N_{i+1} = omega N_i. Empty without ``stream.progressive``, or when there is only one stage.
    The paper leaves omega and the treatment of inactive levels open: here they keep their previous attributes, and
    their gates start from the confidence when their turn comes.
    """
    if not stream.progressive:
        return ()
    levels = np.unique(unit_of).tolist()
    waiting = levels[len(levels) // 2 :]
    if len(waiting) < 2:
        return ()
    weights = [OMEGA**i for i in range(len(waiting))]
    ends = np.cumsum(weights) / sum(weights)
    return tuple(zip(ends.tolist(), waiting, strict=True))


def current_level(schedule: tuple[tuple[float, int], ...], fraction: float) -> int:
    """Return the finest level that takes part at this fraction [0, 1) of the frame's iterations."""
    return next((level for end, level in schedule if fraction < end), schedule[-1][1])


#: Spacing of float32 below 1: a smaller gradient changes no gate by a logit's step.
RESOLUTION = 2.0**-24


def count_dead_gates(gate: GateSampler, logits: torch.Tensor) -> int:
    """Count the gates with these logits [M] that neither the images nor the price can move.

    A gate is dead where the derivatives of the deterministic gate and of the open probability are below RESOLUTION.
    """
    leaf = logits.detach().clone().requires_grad_()
    with torch.enable_grad():
        outputs = [value for value in (gate.sample(leaf, None), gate.open_probability(leaf)) if value.requires_grad]
        grads = [torch.autograd.grad(value.sum(), leaf)[0].abs() for value in outputs]
    if not grads:
        return 0
    return int((torch.stack(grads).amax(0) < RESOLUTION).sum())
