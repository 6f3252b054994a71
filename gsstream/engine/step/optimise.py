"""Optimise one frame's gates and residuals. Only candidates take part."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch

from gsstream.core.gaussians import Gaussians
from gsstream.core.hierarchy import Hierarchy
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.assembly.checks import Checks
from gsstream.engine.assembly.guard import blaming, plain
from gsstream.engine.budget.pace import Pace, estimated_bytes
from gsstream.engine.fit.backward import pull_back
from gsstream.engine.fit.residual_table import JointTable, lr_factor
from gsstream.engine.fit.row_table import RowTable
from gsstream.engine.fit.schedule import GATE_LR
from gsstream.engine.step.active.candidates import released
from gsstream.engine.step.dead_gates import count_dead
from gsstream.engine.step.levels import current_level, level_schedule
from gsstream.engine.step.problem import Problem, Solution
from gsstream.engine.step.quiet_tiles import QuietTiles
from gsstream.gate.base import RoundedSigmoid
from gsstream.optimiser.base import ResidualPass, ResidualTable
from gsstream.regularizer.base import GatePrice
from gsstream.residual.base import coarser, init_latents
from gsstream.residual.joint import JointCode, joint_code

#: Rows leave only when at least a tenth of them can: each time, every view has to be frozen anew.
WORTH_LEAVING = 0.9


def optimise(parts: Assembly, problem: Problem, generator: torch.Generator) -> Solution:
    """Minimise photometric loss + penalty over epochs x views, one view per iteration.

    After every epoch rows whose gate has closed may leave, as the recipe says.

    Arguments:
        parts: the live parts of the recipe.
        problem: candidates, their gates, and what they are compared with.
        generator: of noise and of the order of views.
    """
    if len(problem.rows) == 0:
        return Solution(problem.rows, {}, {}, problem.logits)
    stream, views = parts.recipe.stream, problem.views
    epochs = max(1, round(stream.epochs * problem.effort))
    pace = Pace(problem.allowance, epochs, stream.rate_weight, views, problem.effort)
    run = _FrameRun(parts, problem, generator, pace)
    loss, epoch = 0.0, 0
    pace.begin(len(problem.rows))
    while epoch < pace.epochs:
        losses: list[float] = []
        # Reversed, because older versions took views from the end of the list: so equal seeds still give equal bytes.
        order = torch.randperm(views, generator=generator).tolist()[::-1]
        at_a_time = 1 if pace.is_timed else views
        for begin in range(0, views, at_a_time):
            losses += run.iterate(order[begin : begin + at_a_time], epoch * views + begin)
            if pace.is_over():
                return run.solution(sum(losses) / len(losses), epoch * views + len(losses))
        epoch += 1
        loss = sum(losses) / views
        pace.end_epoch(epoch)
        if stream.release_closed and epoch < pace.epochs:
            run.release(epoch / pace.epochs)
            if len(run.rows) == 0:
                break
        if pace.meets_size:
            pace.meet_size(epoch, run.estimated_bytes())
    return run.solution(loss, epoch * views)


class _FrameRun:
    """The moving state of one frame's optimisation; lives only inside :func:`optimise`."""

    def __init__(self, parts: Assembly, problem: Problem, generator: torch.Generator, pace: Pace) -> None:
        self.parts, self.problem, self.generator, self.pace = parts, problem, generator, pace
        self.rows = problem.rows
        self.tiles = QuietTiles(problem.near, parts.recipe.stream.quiet_tiles, generator)
        layout, rows = problem.layout, problem.rows.numpy()
        # Only gates with candidates behind them are sampled and trained. Sampling does not look at parents, so the
        # forest is replaced by roots.
        self.nodes, node_of = torch.unique(problem.hierarchy.node_of[problem.rows], return_inverse=True)
        self.logits = problem.logits
        self.hierarchy = _forest(node_of, len(self.nodes))
        self.levels = torch.from_numpy(layout.unit_of[rows].astype("int64"))
        self.schedule = level_schedule(parts.recipe.stream, layout.unit_of)
        codes = coarser(parts.update.codes(), problem.step_scale)
        latents = init_latents(parts.update, problem.base)
        self.decoder_names = {name: problem.decoders[name] for name in latents if name in problem.decoders}
        self.code = code = joint_code(codes, latents, self.decoder_names, problem.base)
        units = torch.from_numpy(layout.units_of(rows))
        self.table = _table(parts, code, problem.base, units, code.join_decoders(self.decoder_names))
        rates = {"logits": GATE_LR}
        self.gate = RowTable({"logits": problem.logits[self.nodes]}, rates, parts.optimiser)
        # Where both parts have known formulas nothing is differentiated; with the level "step" every call is looked at.
        known = parts.checks is not Checks.STEP
        self.law: RoundedSigmoid | None = parts.gate.law() if known else None
        self.price: GatePrice | None = parts.regularizer.price() if known else None

    def iterate(self, order: Sequence[int], first: int) -> list[float]:
        """Make one iteration on each of these views, the first with this number; return the photometric losses.

        Where the parts have a short cut for all of them it is taken; what it leaves is made here, one by one.
        """
        self.parts.where.iteration = first
        weights = [self.tiles.weights(view) for view in order]
        losses = self._in_one_go(order, first, weights)
        left = range(len(losses), len(order))
        return losses + [self.step(order[place], first + place, weights[place]) for place in left]

    def _in_one_go(self, order: Sequence[int], first: int, weights: Sequence[torch.Tensor | None]) -> list[float]:
        """Losses of the iterations that the table makes in one call; empty where it makes none."""
        judge = self.problem.judge
        if self.law is None or self.price is None or not judge.in_one_go:
            return []
        numbers = range(first, first + len(order))
        with blaming("optimiser", self.parts.part("optimiser"), self.parts.where):
            return self.table.run(ResidualPass(
                session=plain(self.problem.session),
                views=order,
                comparisons=list(map(judge.comparison, order, weights)),
                waiting=[self._waiting(self._fraction(number)) for number in numbers],
                lr_factors=[self._lr_factor(number) for number in numbers],
                law=self.law,
                price=self.price,
                logits=self.gate["logits"],
                state=self.gate.state("logits"),
                gate_lr=GATE_LR,
                node_of=self.hierarchy.node_of,
                num_gaussians=self.problem.hierarchy.num_gaussians,
                rate_weight=self.pace.rate_weight / self.problem.pixels,
            ))  # fmt: skip

    def _fraction(self, iteration: int) -> float:
        return iteration / (self.pace.epochs * self.problem.views)

    def _lr_factor(self, iteration: int) -> float:
        iterations = self.pace.epochs * self.problem.views
        return lr_factor(self.parts.recipe.stream.lr_final_factor, iteration, iterations)

    def step(self, view: int, iteration: int, weights: torch.Tensor | None) -> float:
        """Make one iteration on one view, with these factors on its tiles; return the photometric loss."""
        self.parts.where.iteration = iteration
        logits, waiting = self.gate["logits"], self._waiting(self._fraction(iteration))
        if self.law is None or self.price is None:
            gates = self._row_gates(logits, waiting)
        else:
            gates = self._known_gates(self.law, waiting)
        shut = gates.detach()
        with blaming("optimiser", self.parts.part("optimiser"), self.parts.where):
            rows = self.table.rows(shut)
        loss, gradients = self.problem.judge.pull(self.problem.session, view, rows, weights)
        with blaming("optimiser", self.parts.part("optimiser"), self.parts.where):
            by_gate = self.table.pull(gradients, self.pace.rate_weight / self.problem.pixels)
        if self.law is None or self.price is None:
            self._step_gates(logits, gates, by_gate)
        else:
            self._step_known(self.law, self.price, by_gate if waiting is None else by_gate * ~waiting)
        with blaming("optimiser", self.parts.part("optimiser"), self.parts.where):
            self.table.step(self._lr_factor(iteration))
        return loss

    def _step_gates(self, logits: torch.Tensor, gates: torch.Tensor, upstream: torch.Tensor) -> None:
        """Move the logits by what the images and the penalty say, and keep them in their bounds."""
        roots, gradients = ([gates], [upstream]) if gates.requires_grad else ([], [])
        for penalty in self._penalty(logits).values():
            if penalty.requires_grad:
                roots.append(penalty)
                gradients.append(torch.ones_like(penalty))
        if not roots:
            return
        pull_back(roots, gradients)
        self.gate.step()
        self.gate["logits"].data.copy_(self.parts.gate.bound(self.gate["logits"].detach()))

    def _known_gates(self, law: RoundedSigmoid, waiting: torch.Tensor | None) -> torch.Tensor:
        """What :meth:`_row_gates` returns, without a graph; how the gates change with the logits is kept."""
        gates, self._slopes = law.gates(self.gate["logits"].detach())
        per_row = gates[self.hierarchy.node_of]
        return per_row if waiting is None else per_row * ~waiting

    def _step_known(self, law: RoundedSigmoid, price: GatePrice, by_gate: torch.Tensor) -> None:
        """Do what :meth:`_step_gates` does, by the formulas of the gate and of the penalty."""
        logits, node_of = self.gate["logits"].detach(), self.hierarchy.node_of
        upstream = torch.zeros_like(logits).index_add_(0, node_of, by_gate) * self._slopes
        probability, slope = law.probability(logits)
        total, residual = self.problem.hierarchy.num_gaussians, self._residual().detach()
        by_probability, by_residual = price.slopes(probability, residual, self.hierarchy, total)
        if price.motion and "means" in self.code.latent:
            waits = torch.zeros(self.table.latents.shape)
            waits[:, self.code.latent["means"]] = by_residual
            self.table.latents.grad = waits
        self.gate.step({"logits": upstream + slope * by_probability})
        self.gate["logits"].data.clamp_(-law.bound, law.bound)

    def _row_gates(self, logits: torch.Tensor, waiting: torch.Tensor | None) -> torch.Tensor:
        """[A] gate of every candidate; rows of levels that are not yet trained hold still."""
        noise = self.parts.gate.noise(self.hierarchy.num_nodes, self.generator)
        per_row = self.parts.gate.sample(logits, noise)[self.hierarchy.node_of]
        return per_row if waiting is None else per_row * ~waiting

    def _waiting(self, fraction: float) -> torch.Tensor | None:
        """[A] bool: rows whose level is not trained yet at this share of the frame; None: all take part."""
        return self.levels > current_level(self.schedule, fraction) if self.schedule else None

    def _residual(self) -> torch.Tensor:
        """[A, 3] ungated position residual, in units of the rows: a view of the leaf."""
        columns = self.code.latent.get("means")
        return torch.zeros(len(self.rows), 3) if columns is None else self.table.latents[:, columns]

    def _penalty(self, logits: torch.Tensor) -> Mapping[str, torch.Tensor]:
        # The motion term also has a gradient with respect to the residual; it stays on the leaf until the latents step.
        residual = self._residual()
        probability = self.parts.gate.open_probability(logits)
        total = self.problem.hierarchy.num_gaussians
        return self.parts.regularizer.penalty(probability, residual, self.hierarchy, total)

    def release(self, fraction: float) -> None:
        """Let go of the rows whose gate has closed: they no longer cost anything in this frame."""
        gates = self.parts.gate.sample(self.gate["logits"].detach(), None)
        keep = released(gates, self.parts.gate.num_levels, self.hierarchy, self._waiting(fraction))
        if int(keep.sum()) > WORTH_LEAVING * len(keep):
            return
        self.logits = self._all_logits()
        rows = keep.nonzero()[:, 0]
        nodes, node_of = torch.unique(self.hierarchy.node_of[rows], return_inverse=True)
        self.nodes, self.hierarchy = self.nodes[nodes], _forest(node_of, len(nodes))
        self.gate.keep(nodes)
        self.table.keep(rows)
        self.rows, self.levels = self.rows[rows], self.levels[rows]
        self.problem.session.narrow(self.rows)

    def estimated_bytes(self) -> float:
        """What a packet would hold if this pass were the last: symbols behind open gates, and the gates."""
        gates = self.parts.gate.sample(self.gate["logits"].detach(), None)
        opened = torch.round(gates * self.parts.gate.num_levels) > 0
        latents = self.table.latents.detach()[opened[self.hierarchy.node_of]]
        return estimated_bytes(torch.round(latents / self.code.steps)) + float(opened.sum())

    def _all_logits(self) -> torch.Tensor:
        """[M] logits of all gates; those that take part as they are now."""
        return self.logits.index_copy(0, self.nodes, self.gate["logits"].detach())

    def solution(self, loss: float, iterations: int) -> Solution:
        """What was found after so many iterations."""
        dead = count_dead(self.parts.gate, self.gate["logits"])
        self.parts.where.iteration = None
        self.pace.close()
        return Solution(
            rows=self.rows,
            latents=self.code.split(self.table.latents.detach()),
            decoders=self.code.split_decoders(self.table.matrix, self.decoder_names),
            logits=self._all_logits(),
            loss=loss,
            iterations=iterations,
            curvature=self.code.split(self.table.curvature),
            pace=self.pace,
            dead_gates=dead,
        )


def _forest(node_of: torch.Tensor, number: int) -> Hierarchy:
    """``number`` roots and nothing else."""
    roots = torch.arange(number)
    return Hierarchy(node_of, roots, torch.zeros_like(roots))


def _table(
    parts: Assembly, code: JointCode, base: Gaussians[torch.Tensor], units: torch.Tensor, matrix: torch.Tensor
) -> ResidualTable:
    """The optimiser's own table of residuals where it has one; with the level "step", one whose every step is seen."""
    fast = None if parts.checks is Checks.STEP else parts.optimiser.residual_table(code, base, units, matrix)
    return JointTable(code, base, units, matrix, parts.optimiser) if fast is None else fast
