"""Optimising one frame: epochs over the training cameras, masked at first, with added Gaussians in between."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from gsstream.api import Cameras, FrameTools, Gaussians, WrtRows
from gsstream.backend import Renderer, RenderSession
from gsstream.blocks import DensifyStatistics, rows_backward
from gsstream_queen.densify import densify, densify_epochs
from gsstream_queen.settings import QueenConfig
from gsstream_queen.trainable import NewRows, OldRows, Solution, concat


@dataclass(frozen=True)
class Problem:
    """What a frame's optimisation is given."""

    work: FrameTools  # the frame, opened on the decoded scene before it
    renderer: Renderer
    background: tuple[float, float, float]
    active: torch.Tensor  # [A] int64 rows that are trained, ascending
    dynamic: torch.Tensor  # [N] bool, who changed
    masks: list[torch.Tensor] | None  # per view changed tiles, None without masking
    logits: torch.Tensor  # [A] gates
    weights: dict[str, torch.Tensor]  # what is learned of each decoder
    epochs: int


@dataclass(frozen=True)
class Result:
    """``added`` Gaussians; ``gone`` [N] bool, rows that leave; ``loss``: mean of the last epoch."""

    solution: Solution
    added: Gaussians[torch.Tensor]
    gone: torch.Tensor
    loss: float
    iterations: int


def optimise(config: QueenConfig, problem: Problem, generator: torch.Generator) -> Result:
    """Minimise the photometric loss and the L0 penalty, one view per iteration."""
    run = _Frame(config, problem, generator)
    events = densify_epochs(config.growth, problem.epochs)
    views = len(problem.work.cameras)
    masked = round(config.mask.share * problem.epochs * views) if problem.masks is not None else 0
    losses: list[float] = []
    for epoch in range(problem.epochs):
        watch = any(event > epoch for event in events)
        for view in torch.randperm(views, generator=generator).tolist():
            losses.append(run.step(view, masked=len(losses) < masked, watch=watch))
        if epoch + 1 in events:
            run.densify()
    return run.result(sum(losses[-views:]) / views, len(losses))


class _Frame:
    """The moving state of one frame's optimisation; lives only inside :func:`optimise`."""

    def __init__(self, config: QueenConfig, problem: Problem, generator: torch.Generator) -> None:
        self._config, self._problem, self._generator = config, problem, generator
        self._scene = problem.work.gaussians
        self._cameras: Cameras = problem.work.cameras
        self._extent = self._cameras.extent
        self._old = OldRows(
            config=config,
            base=self._scene.rows(problem.active),
            logits=problem.logits,
            weights=problem.weights,
            extent=self._extent,
            total=len(self._scene),
            pixels=self._cameras.width * self._cameras.height,
        )
        self._new: list[NewRows] = []
        #: Rows of the scene that a split replaced.
        self._gone = torch.zeros(len(self._scene), dtype=torch.bool)
        self._session: RenderSession = problem.work.session
        if len(problem.active) < len(self._scene):
            self._session.narrow(problem.active)
        self._statistics = DensifyStatistics.zeros(len(problem.active), problem.active.device)

    @property
    def _alive(self) -> torch.Tensor:
        """[A] bool."""
        return ~self._gone[self._problem.active]

    def _values(self) -> Gaussians[torch.Tensor]:
        """Everything that is trained: old rows that are still there, then the new ones."""
        old = self._old.values()
        return concat([old.rows(self._alive) if self._new else old, *(rows.values() for rows in self._new)])

    def step(self, view: int, *, masked: bool, watch: bool) -> float:
        """One iteration on one view; returns the loss. ``watch``: keep statistics for the next densification."""
        mask = self._problem.masks[view] if masked and self._problem.masks is not None else None
        if mask is not None and not bool(mask.any()):
            return 0.0
        rows = self._values()
        target = self._problem.work.view_target(view, None if mask is None else mask.float())
        found = self._session.loss_and_grad(view, target, WrtRows(rows, means2d=True))
        rows_backward(rows, found.grad)
        if watch and found.means2d is not None:
            self._watch(found.means2d)
        self._old.step()
        for group in self._new:
            group.step()
        return float(found.loss)

    def _watch(self, gradient: torch.Tensor) -> None:
        half = torch.tensor([self._cameras.width / 2, self._cameras.height / 2])
        alive = self._alive
        full = torch.zeros(len(alive), 2)
        full[alive] = gradient[: int(alive.sum())] * half
        self._statistics = self._statistics.add(full)

    def densify(self) -> None:
        """Clone and split dynamic rows; from then on the session renders the new rows too."""
        config = self._config.growth
        added_so_far = sum(len(rows) for rows in self._new)
        with torch.no_grad():
            rows = self._old.values()
            allowed = self._alive & self._problem.dynamic[self._problem.active]
            new = densify(
                rows,
                self._statistics.mean,
                allowed,
                room=config.max_added - added_so_far,
                extent=self._extent,
                settings=config,
                generator=self._generator,
            )
        self._statistics = DensifyStatistics.zeros(len(self._problem.active), self._problem.active.device)
        if len(new.gaussians) == 0:
            return
        self._gone[self._problem.active[new.replaced]] = True
        self._new.append(NewRows(new.gaussians, self._config.means.lr * self._extent))
        self._open()

    def _open(self) -> None:
        """Return a session of the scene without removed and with added Gaussians."""
        added = [rows.values().map(torch.Tensor.detach) for rows in self._new]
        scene = concat([self._scene.rows(~self._gone), *added])
        trained = torch.zeros(len(self._scene), dtype=torch.bool)
        trained[self._problem.active] = True
        old = trained[~self._gone].nonzero()[:, 0]
        number = int((~self._gone).sum())
        active = torch.cat([old, torch.arange(number, len(scene))])
        chosen = active if len(active) < len(scene) else None
        self._session = self._problem.renderer.open(scene, chosen, self._cameras, self._problem.background)

    def result(self, loss: float, iterations: int) -> Result:
        """What is to be sent; transparent new rows are not, transparent dynamic ones leave."""
        with torch.no_grad():
            faint = self._old.values().opacities.sigmoid() < self._config.growth.prune_opacity
            added = concat([rows.values() for rows in self._new]) if self._new else self._scene.rows(slice(0, 0))
            added = added.map(torch.Tensor.detach)
            added = added.rows(added.opacities.sigmoid() >= self._config.growth.prune_opacity)
        active = self._problem.active
        gone = self._gone.clone()
        if self._config.growth.every:
            gone[active[faint]] |= self._problem.dynamic[active[faint]]
        return Result(solution=self._old.solution(), added=added, gone=gone, loss=loss, iterations=iterations)
