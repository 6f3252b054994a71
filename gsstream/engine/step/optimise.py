"""Optimise one frame's gates and residuals. Only candidates take part."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from gsstream.core.hierarchy import Hierarchy
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.budget.pace import Pace, estimated_bytes
from gsstream.engine.fit.backward import pull_back
from gsstream.engine.fit.row_table import RowTable
from gsstream.engine.step.active.candidates import released
from gsstream.engine.step.dead_gates import count_dead
from gsstream.engine.step.levels import current_level, level_schedule
from gsstream.engine.step.problem import Problem, Solution
from gsstream.residual.base import coarser, init_latents
from gsstream.residual.joint import add_joint, decode_joint, join_features, joint_code, pull_back_joint
from gsstream.residual.rate import rate_gradient

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
        for place, view in enumerate(reversed(torch.randperm(views, generator=generator).tolist())):
            iteration = epoch * views + place
            losses.append(run.step(view, iteration, iteration / (pace.epochs * views)))
            if pace.is_over():
                return run.solution(sum(losses) / len(losses), iteration + 1)
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
        self.rows, self.base = problem.rows, problem.base
        layout, rows = problem.layout, problem.rows.numpy()
        # Only gates with candidates behind them are sampled and trained. Sampling does not look at parents, so the
        # forest is replaced by roots.
        self.nodes, node_of = torch.unique(problem.hierarchy.node_of[problem.rows], return_inverse=True)
        self.logits = problem.logits
        self.hierarchy = _forest(node_of, len(self.nodes))
        self.units = torch.from_numpy(layout.units_of(rows))
        self.levels = torch.from_numpy(layout.unit_of[rows].astype("int64"))
        self.schedule = level_schedule(parts.recipe.stream, layout.unit_of)
        codes = coarser(parts.update.codes(), problem.step_scale)
        latents = init_latents(parts.update, problem.base)
        self.decoder_names = {name: problem.decoders[name] for name in latents if name in problem.decoders}
        self.code = code = joint_code(codes, latents, self.decoder_names, problem.base)
        self.features = join_features(code, problem.base)
        start = torch.zeros(len(problem.base), code.width)
        self.latents = RowTable({"latents": start}, {"latents": code.lrs}, parts.optimiser)
        matrix = code.join_decoders(self.decoder_names)
        self.decoders = RowTable({"matrix": matrix}, {"matrix": code.decoder_lrs}, parts.optimiser)
        rates = {"logits": parts.recipe.gate_training.lr}
        self.gate = RowTable({"logits": problem.logits[self.nodes]}, rates, parts.optimiser)

    def step(self, view: int, iteration: int, fraction: float) -> float:
        """Make one iteration on one view; return the photometric loss."""
        self.parts.where.iteration = iteration
        logits = self.gate["logits"]
        gates = self._row_gates(logits, fraction)
        shut = gates.detach()
        latents, matrix = self.latents["latents"].detach(), self.decoders["matrix"].detach()
        change = decode_joint(self.code, latents, matrix, self.units)
        rows = add_joint(self.code, self.base, self.features, change, shut).map(_leaf)
        output = self.problem.session.render(view, rows)
        loss, _ = self.problem.judge.backward(view, output.image, output.tiles)
        upstream = join_features(self.code, rows.map(_gradient))
        back = pull_back_joint(self.code, upstream, change, matrix, shut, self.units)
        if self.pace.rate_weight:
            weight = self.pace.rate_weight / self.problem.pixels
            back.latents.add_(rate_gradient(latents, self.code.steps, shut, weight))
        self._step_gates(logits, gates, back.gates)
        self.latents.step({"latents": back.latents})
        self.decoders.step({"matrix": back.matrix})
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

    def _row_gates(self, logits: torch.Tensor, fraction: float) -> torch.Tensor:
        """[A] gate of every candidate; rows of levels that are not yet trained hold still."""
        noise = self.parts.gate.noise(self.hierarchy.num_nodes, self.generator)
        per_row = self.parts.gate.sample(logits, noise)[self.hierarchy.node_of]
        waiting = self._waiting(fraction)
        return per_row if waiting is None else per_row * ~waiting

    def _waiting(self, fraction: float) -> torch.Tensor | None:
        """[A] bool: rows whose level is not trained yet at this share of the frame; None: all take part."""
        return self.levels > current_level(self.schedule, fraction) if self.schedule else None

    def _penalty(self, logits: torch.Tensor) -> Mapping[str, torch.Tensor]:
        columns = self.code.latent.get("means")
        # The motion term also has a gradient with respect to the residual; it stays on the leaf until the latents step.
        residual = torch.zeros(len(self.base), 3) if columns is None else self.latents["latents"][:, columns]
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
        self.latents.keep(rows)
        self.rows, self.base, self.features = self.rows[rows], self.base.rows(rows), self.features[rows]
        self.units, self.levels = self.units[rows], self.levels[rows]
        self.problem.session.narrow(self.rows)

    def estimated_bytes(self) -> float:
        """What a packet would hold if this pass were the last: symbols behind open gates, and the gates."""
        gates = self.parts.gate.sample(self.gate["logits"].detach(), None)
        opened = torch.round(gates * self.parts.gate.num_levels) > 0
        latents = self.latents["latents"].detach()[opened[self.hierarchy.node_of]]
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
            latents=self.code.split(self.latents["latents"].detach()),
            decoders=self.code.split_decoders(self.decoders["matrix"].detach(), self.decoder_names),
            logits=self._all_logits(),
            loss=loss,
            iterations=iterations,
            curvature=self.code.split(self.latents.moments("latents")["exp_avg_sq"]),
            pace=self.pace,
            dead_gates=dead,
        )


def _forest(node_of: torch.Tensor, number: int) -> Hierarchy:
    """``number`` roots and nothing else."""
    roots = torch.arange(number)
    return Hierarchy(node_of, roots, torch.zeros_like(roots))


def _leaf(value: torch.Tensor) -> torch.Tensor:
    return value.detach().requires_grad_()


def _gradient(value: torch.Tensor) -> torch.Tensor:
    """Gradient of a leaf; zeros where nothing reached it."""
    return torch.zeros_like(value) if value.grad is None else value.grad
