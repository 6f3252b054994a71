"""Optimise one frame's gates and residuals. Only rows whose gate may open take part."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import AbstractContextManager

import torch

from gsstream.core.gaussians import Gaussians
from gsstream.core.hierarchy import Hierarchy
from gsstream.core.part import Part
from gsstream.core.state import GateState
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.fit.backward import pull_back
from gsstream.engine.budget.pace import Pace, estimated_bytes
from gsstream.engine.assembly.checks import UNIT, StepChecks, check_terms
from gsstream.engine.step.dead_gates import count_dead
from gsstream.engine.fit.exposure import Exposure, backward_view
from gsstream.engine.assembly.guard import guarded
from gsstream.engine.step.levels import current_level, level_schedule
from gsstream.engine.step.problem import Problem, Solution
from gsstream.engine.fit.row_table import RowTable
from gsstream.engine.stopping import Gains, watch
from gsstream.residual.base import coarser, init_latents
from gsstream.residual.joint import add_joint, decode_joint, join_features, joint_code, pull_back_joint
from gsstream.residual.rate import rate_gradient

#: Leaving costs a freeze of every view: at least a tenth of the rows must go.
WORTH_LEAVING = 0.9


def optimise(parts: Assembly, problem: Problem, generator: torch.Generator) -> Solution:
    """Minimise photometric loss + penalty over epochs x views, one view per iteration.

    After every epoch rows whose gate has closed may leave, and the frame may stop, as the recipe says.
    """
    stream = parts.recipe.stream
    if len(problem.active) == 0:
        return Solution(problem.active, {}, {}, problem.gate, problem.state.gate_moments, 0.0, 0)
    views = len(problem.frame.cameras)
    epochs, effort = max(1, round(stream.epochs * problem.frame.effort)), problem.frame.effort
    pace = Pace(problem.allowance, epochs, stream.rate_weight, views, effort)
    run, gains = _FrameRun(parts, problem, generator, pace), Gains(views)
    loss, epoch = 0.0, 0
    pace.begin(len(problem.active))
    while epoch < pace.epochs:
        losses: list[float] = []
        for place, view in enumerate(reversed(torch.randperm(views, generator=generator).tolist())):
            iteration = epoch * views + place
            losses.append(run.step(view, iteration, iteration / (pace.epochs * views)))
            gains.note(view, losses[-1], run.judged_tiles)
            if pace.is_over():
                return run.solution(sum(losses) / len(losses), iteration + 1)
        epoch += 1
        loss = sum(losses) / views
        pace.end_epoch(epoch)
        if gains.end_epoch() < stream.min_gain:
            break
        if stream.release_closed and epoch < pace.epochs:
            run.release(epoch / pace.epochs)
            if len(run.active) == 0:
                break
        if pace.meets_size:
            pace.meet_size(epoch, run.estimated_bytes())
    return run.solution(loss, epoch * views)


class _FrameRun:
    """The moving state of one frame's optimisation; lives only inside :func:`optimise`."""

    def __init__(self, parts: Assembly, problem: Problem, generator: torch.Generator, pace: Pace) -> None:
        self.parts, self.problem, self.generator, self.pace = parts, problem, generator, pace
        state, layout = problem.state, problem.state.player.layout
        nodes, node_of = torch.unique(state.hierarchy.node_of[problem.active], return_inverse=True)
        if parts.recipe.gate_training.optimiser == "persistent":
            nodes, node_of = torch.arange(state.hierarchy.num_nodes), state.hierarchy.node_of[problem.active]
        # Only gates with active rows behind them are sampled and trained; parents matter to no gate.
        self.nodes = nodes
        self.logits, self.active, self.base = problem.gate.logits, problem.active, problem.base
        self.hierarchy = Hierarchy(node_of, torch.arange(len(nodes)), torch.zeros_like(nodes))
        active = problem.active.numpy()
        self.units = torch.from_numpy(layout.units[active])
        self.levels = torch.from_numpy(layout.octree_levels[active].astype("int64"))
        self.schedule = level_schedule(parts, len(layout.cell_sizes))
        self.iteration = 0
        self.look = StepChecks(parts.checks, problem.frame.index)
        with self._guarded("update", parts.update):
            codes = coarser(parts.update.codes(), problem.step_scale)
        latents = init_latents(parts.update, problem.base)
        self.decoder_names = {name: state.decoders[name] for name in latents if name in state.decoders}
        self.code = code = joint_code(codes, latents, self.decoder_names, problem.base)
        self.features = join_features(code, problem.base)
        start = torch.zeros(len(problem.base), code.width)
        self.latents = RowTable({"latents": start}, {"latents": code.lrs}, parts.optimiser)
        matrix = code.join_decoders(self.decoder_names)
        self.decoders = RowTable({"matrix": matrix}, {"matrix": code.decoder_lrs}, parts.optimiser)
        rates = {"logits": parts.recipe.gate_training.lr}
        self.gate = RowTable({"logits": problem.gate.logits[nodes]}, rates, parts.optimiser)
        self.gate.load_moments("logits", state.gate_moments)
        self.session = problem.session
        with self._guarded("loss", parts.loss):
            self.targets = [parts.loss.prepare(torch.from_numpy(image)) for image in problem.frame.images]
        self.exposure: Exposure | None = state.exposure
        cameras = problem.frame.cameras
        self.pixels = cameras.width * cameras.height
        self.watched: dict[int, torch.Tensor] = {}
        #: Tiles that the last view's loss is a sum over; 0: all.
        self.judged_tiles = 0

    def _guarded(self, slot: str, part: Part) -> AbstractContextManager[None]:
        return guarded(slot, part, self.problem.frame.index, self.iteration)

    def step(self, view: int, iteration: int, fraction: float) -> float:
        """One iteration on one view; returns the photometric loss."""
        parts, look = self.parts, self.look
        self.iteration = look.iteration = iteration
        gate = GateState(self.gate["logits"])
        gates = self._row_gates(gate, fraction)
        latents, matrix = self.latents["latents"].detach(), self.decoders["matrix"].detach()
        change = decode_joint(self.code, latents, matrix, self.units)
        shut = gates.detach()
        rows = add_joint(self.code, self.base, self.features, change, shut)
        look("update", parts.update, "changed rows,", rows, rows=self.active)
        rows = rows.map(lambda value: value.detach().requires_grad_())
        loss = self._render(view, rows)
        upstream = join_features(self.code, rows.map(_gradient))
        back = pull_back_joint(self.code, upstream, change, matrix, shut, self.units)
        look("update", parts.update, "gradient of latents", back.latents, rows=self.active)
        look("update", parts.update, "gradient of decoders", back.matrix)
        if self.pace.rate_weight:
            weight = self.pace.rate_weight / self.pixels
            back.latents.add_(rate_gradient(latents, self.code.steps, shut, weight))
        self._step_gates(gate, gates, back.gates, learning=fraction >= parts.recipe.gate_training.warmup)
        with self._guarded("optimiser", parts.optimiser):
            self.latents.step({"latents": back.latents})
            self.decoders.step({"matrix": back.matrix})
        look("optimiser", parts.optimiser, "latents", self.latents["latents"], rows=self.active)
        look("optimiser", parts.optimiser, "decoders", self.decoders["matrix"])
        return loss

    def _render(self, view: int, rows: Gaussians[torch.Tensor]) -> float:
        """Loss of one view; leaves its gradient on the rows."""
        with self._guarded("renderer", self.parts.renderer):
            output = self.session.render(view, rows)
        self.look("renderer", self.parts.renderer, f"image of view {view}", output.image)
        weight, target, tiles = self.parts.recipe.loss.dssim, self.targets[view], output.tiles
        if tiles is not None and self.parts.recipe.stream.min_gain > 0:
            tiles = self.watched[view] = watch(self.watched.get(view), tiles)
        self.judged_tiles = 0 if tiles is None else int(tiles.sum())
        with self._guarded("loss", self.parts.loss):
            loss, gradient = backward_view(output.image, view, self.exposure, self.parts.loss, target, weight, tiles)
        self.look.number("loss", self.parts.loss, f"loss of view {view}", loss)
        self.look("loss", self.parts.loss, f"gradient of the image of view {view}", gradient)
        self.look.gradients("renderer", self.parts.renderer, "gradient of rows,", rows, self.active)
        return loss

    def _step_gates(self, gate: GateState, gates: torch.Tensor, upstream: torch.Tensor, *, learning: bool) -> None:
        """Move the logits by what the images and the penalty say, and keep them in their bounds."""
        if not learning:
            return
        roots, gradients = [], []
        if gates.requires_grad:
            roots, gradients = [gates], [upstream]
        for penalty in self._penalty(gate).values():
            if penalty.requires_grad:
                roots.append(penalty)
                gradients.append(torch.ones_like(penalty))
        if not roots:
            return
        with self._guarded("gate", self.parts.gate):
            pull_back(roots, gradients)
            self.gate.step()
            bounded = self.parts.gate.bound(GateState(self.gate["logits"].detach())).logits
            self.gate["logits"].data.copy_(bounded)
        self.look("gate", self.parts.gate, "bound().logits", bounded)

    def _row_gates(self, gate: GateState, fraction: float) -> torch.Tensor:
        """[A] gate of every active row; rows of levels that are not yet active hold still."""
        with self._guarded("gate", self.parts.gate):
            noise = self.parts.gate.noise(self.hierarchy.num_nodes, self.generator)
            sample = self.parts.gate.sample(gate, noise)
        self.look("gate", self.parts.gate, "sample()", sample, UNIT)
        per_row = sample[self.hierarchy.node_of]
        if self.schedule:
            per_row = per_row * (self.levels <= current_level(self.schedule, fraction))
        return per_row

    def _penalty(self, gate: GateState) -> Mapping[str, torch.Tensor]:
        columns = self.code.latent.get("means")
        # The motion term also pulls on the residual itself; that gradient waits on the leaf for the latents' step.
        residual = torch.zeros(len(self.base), 3) if columns is None else self.latents["latents"][:, columns]
        with self._guarded("gate", self.parts.gate):
            probability = self.parts.gate.open_probability(gate)
        total, regularizer = self.problem.state.hierarchy.num_gaussians, self.parts.regularizer
        with self._guarded("regularizer", regularizer):
            terms = regularizer.penalty(probability, residual, self.hierarchy, total)
            check_terms(self.parts.checks, regularizer, self.problem.frame.index, self.iteration, terms)
        return terms

    def release(self, fraction: float) -> None:
        """Let go of the rows whose gate has closed: they no longer cost anything in this frame.

        A closed gate draws its rows as they were, so nothing that is seen changes. Rows of levels that are not yet
        active had no say and stay.
        """
        if self.parts.recipe.gate_training.optimiser == "persistent":
            return
        with self._guarded("gate", self.parts.gate):
            gates = self.parts.gate.sample(GateState(self.gate["logits"].detach()), None)
        keep = (torch.round(gates * self.parts.gate.num_levels) > 0)[self.hierarchy.node_of]
        if self.schedule:
            keep |= self.levels > current_level(self.schedule, fraction)
        if int(keep.sum()) > WORTH_LEAVING * len(keep):
            return
        self.logits = self._all_logits()
        rows = keep.nonzero()[:, 0]
        nodes, node_of = torch.unique(self.hierarchy.node_of[rows], return_inverse=True)
        self.nodes = self.nodes[nodes]
        self.hierarchy = Hierarchy(node_of, torch.arange(len(nodes)), torch.zeros_like(nodes))
        self.gate.keep(nodes)
        self.latents.keep(rows)
        self.active, self.base, self.features = self.active[rows], self.base.rows(rows), self.features[rows]
        self.units, self.levels = self.units[rows], self.levels[rows]
        with self._guarded("renderer", self.parts.renderer):
            self.session.narrow(self.active)

    def estimated_bytes(self) -> float:
        """What a packet would hold if this pass were the last: symbols behind open gates, and the gates."""
        with self._guarded("gate", self.parts.gate):
            gates = self.parts.gate.sample(GateState(self.gate["logits"].detach()), None)
        opened = torch.round(gates * self.parts.gate.num_levels) > 0
        latents = self.latents["latents"].detach()[opened[self.hierarchy.node_of]]
        return estimated_bytes(torch.round(latents / self.code.steps)) + float(opened.sum())

    def _all_logits(self) -> torch.Tensor:
        """[M] logits of all gates; those that take part as they are now."""
        return self.logits.index_copy(0, self.nodes, self.gate["logits"].detach())

    def solution(self, loss: float, iterations: int) -> Solution:
        with self._guarded("gate", self.parts.gate):
            dead = count_dead(self.parts.gate, self.gate["logits"])
        moments = self.gate.moments("logits") if self.parts.recipe.gate_training.optimiser == "persistent" else {}
        return Solution(
            active=self.active,
            latents=self.code.split(self.latents["latents"].detach()),
            decoders=self.code.split_decoders(self.decoders["matrix"].detach(), self.decoder_names),
            gate=GateState(self._all_logits()),
            gate_moments=moments,
            loss=loss,
            iterations=iterations,
            curvature=self.code.split(self.latents.moments("latents")["exp_avg_sq"]),
            pace=self.pace,
            dead_gates=dead,
        )


def _gradient(value: torch.Tensor) -> torch.Tensor:
    """Gradient of a leaf; zeros where nothing reached it."""
    return torch.zeros_like(value) if value.grad is None else value.grad
