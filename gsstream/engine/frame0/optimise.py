"""The first frame: from anchors to Gaussians that a stream can start from.

The schedule is 3DGS's (Kerbl et al. 2023) with gradient-driven densification and opacity pruning; the exposure fit, the
opacity and scale penalties and the near plane are gsstream's own; held-out quality is why they are there.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import torch

from gsstream.core.deferred import deferred_checks
from gsstream.core.errors import InputError
from gsstream.core.frame import Frame, shrink_frame
from gsstream.core.gaussians import ATTRIBUTES, Gaussians
from gsstream.core.picture_size import area_price, densify_factor, prune_factor
from gsstream.core.rng import Rng
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.assembly.checks import VARIABLE, Checks
from gsstream.engine.assembly.part_in_use import PartInUse
from gsstream.engine.fit import constants
from gsstream.engine.fit.densify import DensifyStatistics, GrowthLimits, grow_and_prune
from gsstream.engine.fit.exposure import ExposureFit
from gsstream.engine.fit.nearest import neighbour_distance
from gsstream.engine.fit.photometric import FrameImages, PhotometricLoss
from gsstream.engine.frame0.hutchinson import TrainingViews
from gsstream.engine.frame0.penalties import add_penalty_grad
from gsstream.engine.frame0.prune import prune_by_error
from gsstream.engine.frame0.pyramid import Pyramid, PyramidLevel, keep_widths, plan_pyramid
from gsstream.engine.frame0.regularisers import Dropout, choose_regularisers
from gsstream.engine.frame0.smooth_depth import SmoothDepth
from gsstream.input.seeds.shell import find_shell
from gsstream.parts.render.activations import logit, rgb_to_sh0
from gsstream.parts.render.exposure import Exposure
from gsstream.parts.render.wrt import LossAndGrad, WrtScene
from gsstream.parts.residual.adam_state import RowParameters, TopologyEdit
from gsstream.parts.structure.base import Anchors
from gsstream.recipe.model import FirstFrame

CENTER_EVERY = 50
CPU = torch.device("cpu")
Progress = Callable[[int, int, float, int], None]


@dataclass(frozen=True)
class Reconstruction:
    """Optimised frame 0. ``levels`` [N] is aligned with the Gaussians."""

    gaussians: Gaussians[torch.Tensor]
    levels: torch.Tensor
    exposure: Exposure | None
    iterations: int


def initial_gaussians(anchors: Anchors, settings: FirstFrame) -> Gaussians[torch.Tensor]:
    """Return one isotropic Gaussian per anchor, as wide as the distance to its three nearest neighbours (3DGS)."""
    count = len(anchors.positions)
    if count == 0:
        raise InputError("the structure placed no anchors: expected at least 1 Gaussian to start from, got 0")
    spacing = neighbour_distance(anchors.positions).clamp(1e-6, 1e6)
    higher = (settings.sh_degree + 1) ** 2 - 1
    return isotropic(anchors.positions, anchors.colors, spacing.log(), opacity=constants.OPACITY, higher=higher)


def isotropic(
    positions: torch.Tensor, colors: torch.Tensor, scales: torch.Tensor, opacity: float, higher: int
) -> Gaussians[torch.Tensor]:
    """Return round Gaussians [N] at positions [N, 3], with colours [N, 3] in [0, 1] from every direction.

    ``scales`` [N] are log standard deviations, ``higher`` is the number of higher colour coefficients.
    """
    count = len(positions)
    quats = torch.zeros(count, 4)
    quats[:, 0] = 1
    return Gaussians(
        means=positions.float().clone(),
        quats=quats,
        scales=scales[:, None].repeat(1, 3),
        opacities=torch.full((count,), logit(opacity)),
        sh0=rgb_to_sh0(colors.float()),
        shN=torch.zeros(count, higher, 3),
    )


def first_frame_lrs(settings: FirstFrame, extent: float) -> dict[str, float]:
    """Return the learning rate of every attribute at the start of frame 0."""
    rates = {
        "quats": constants.LR_QUATS,
        "scales": constants.LR_SCALES,
        "opacities": constants.LR_OPACITIES,
        "sh0": constants.LR_SH0,
        "shN": constants.LR_SHN,
    }
    return {"means": settings.lr_means * extent, **{name: settings.lr_factor * lr for name, lr in rates.items()}}


def optimise_first_frame(
    start: Gaussians[torch.Tensor],
    levels: torch.Tensor,
    frame: Frame,
    assembly: Assembly,
    rng: Rng,
    progress: Progress,
) -> Reconstruction:
    """Fit frame 0 on its training images."""
    settings = assembly.recipe.first_frame
    iterations = min(settings.epochs * len(frame.cameras), settings.max_iterations)
    pyramid = plan_pyramid(frame.cameras.width, iterations, settings)
    run = FirstFrameRun(
        start=start,
        levels=levels,
        frame=frame,
        assembly=assembly,
        generator=rng.stream("first frame", frame.index),
        pyramid=pyramid,
    )
    run.exposure = ExposureFit.start(len(frame.cameras), run.device) if settings.exposure else None
    for level in pyramid.levels:
        run.enter(level)
        for iteration in run.passes(level.begin + 1, level.end):
            progress(iteration, pyramid.iterations, run.smooth, len(run.levels))
    exposure = run.exposure.centered().exposure.to(CPU) if run.exposure else None
    found = run.gaussians().map(lambda value: value.detach().to(CPU))
    assembly.where.enter(frame.index)
    use = PartInUse("first frame", run.table, assembly.where, assembly.checks)
    for name, values in found.items():
        use.values(f"{name} after the last iteration ({VARIABLE}=step finds the first)", values)
    return Reconstruction(found, run.levels.to(CPU), exposure, pyramid.iterations)


class FirstFrameRun:
    """The moving state of an optimisation of all Gaussians; lives only inside the function that makes it.

    Arguments:
        start: [N] Gaussians; ``levels`` [N] their octree levels.
        levels: see above.
        frame: training images at their own size.
        assembly: the live parts of the recipe.
        generator: of the order of views, of splits and of noise.
        pyramid: the whole schedule, of which :meth:`step` makes one iteration; it is on its first level.
    """

    def __init__(
        self,
        start: Gaussians[torch.Tensor],
        levels: torch.Tensor,
        frame: Frame,
        assembly: Assembly,
        generator: torch.Generator,
        pyramid: Pyramid,
    ) -> None:
        self.assembly, self.recipe, self.whole = assembly, assembly.recipe, frame
        self.settings = assembly.recipe.first_frame
        self.renderer, self.device = assembly.renderer, assembly.renderer.device
        self.levels = levels.to(self.device)
        self.views = len(frame.cameras)
        self.extent = frame.cameras.extent
        self.widest = constants.MAX_SCALE * self.extent
        if self.settings.shell:
            self.widest = max(self.widest, constants.MAX_SHELL_SCALE * find_shell(frame.cameras).sigma)
        self.pyramid, self.iterations, self.generator = pyramid, pyramid.iterations, generator
        values = {name: value.to(self.device) for name, value in start.items()}
        self.table = RowParameters(values, first_frame_lrs(self.settings, self.extent), assembly.renderer.optimiser)
        self._set_level(pyramid.levels[0], None)
        #: Colour maps that are fitted together with the scene; None: the colour maps of the photometric loss stay.
        self.exposure: ExposureFit | None = None
        self.statistics = DensifyStatistics.zeros(len(start), self.device)
        self.regularisers = choose_regularisers(self.settings, frame.cameras)
        self.dropout = Dropout(self.regularisers.dropout, self.views, generator)
        #: [N] row of ``start`` that each Gaussian descends from.
        self.ancestors = torch.arange(len(start), device=self.device)
        self.order: list[int] = []
        #: Mean loss of the last iterations, and the losses, tensors [], that the mean does not contain yet.
        self.smooth = math.nan
        self.losses: list[torch.Tensor] = []

    def gaussians(self) -> Gaussians[torch.Tensor]:
        return Gaussians(**{name: self.table[name] for name in ATTRIBUTES})

    def enter(self, level: PyramidLevel) -> None:
        """Go on with pictures of another size: Gaussians keep their drawn width, statistics of growth begin anew."""
        if level == self.level:
            return
        scene = self.gaussians().map(torch.Tensor.detach)
        scene.scales.copy_(keep_widths(scene, self.whole.cameras, self.level.factor, level.factor))
        self.statistics = DensifyStatistics.zeros(len(self.levels), self.device)
        self._set_level(level, self.photometric.exposure)

    def _set_level(self, level: PyramidLevel, exposure: Exposure | None) -> None:
        self.level, self.frame = level, shrink_frame(self.whole, level.factor)
        self.photometric = PhotometricLoss(
            self.assembly.renderer.loss, constants.DSSIM, FrameImages(self.frame.images, self.device), exposure
        )
        self.smooth_depth = SmoothDepth(self.renderer, self.frame, self.device)
        self.half_size = torch.tensor([self.frame.cameras.width / 2, self.frame.cameras.height / 2]).to(self.device)
        self.centers = torch.as_tensor(self.frame.cameras.centers).float().to(self.device)

    def passes(self, first: int, last: int) -> Iterator[int]:
        """Make the iterations from first to last, and yield the number of each.

        On a GPU they are made and looked at by passes over the views: it is waited for with each look.
        """
        at_once = 1 if self.device == CPU else self.views
        for begin in range(first, last + 1, at_once):
            numbers = range(begin, min(begin + at_once, last + 1))
            with deferred_checks(self.assembly.checks is not Checks.STEP):
                for iteration in numbers:
                    self.step(iteration)
            self._read_losses()
            yield from numbers

    def _read_losses(self) -> None:
        for loss in torch.stack(self.losses).cpu().tolist() if self.losses else ():
            self.smooth = loss if math.isnan(self.smooth) else 0.98 * self.smooth + 0.02 * loss
        self.losses = []

    def step(self, iteration: int) -> None:
        """Make one iteration on one view."""
        view, self.assembly.where.iteration = self._next_view(), iteration
        last = self.pyramid.densify_until * self.iterations
        densify = iteration + constants.DENSIFY_EVERY >= constants.DENSIFY_FROM and iteration <= last
        scene = self.gaussians().map(torch.Tensor.detach)
        rows, keep = self.dropout.thin_out(self._disturbed(scene))
        wrt = WrtScene(rows, densify, exposure=self.exposure is not None, keep=keep)
        found = self._loss_and_grad(view, wrt)
        if weight := self.regularisers.smoothness_at(iteration, self.iterations):
            self.smooth_depth.add_grad(wrt.placed(), view, found.grad, weight)
        self.table.set_lr("means", self.extent * self.level.lr_at(iteration))
        price = self._area_price(iteration)
        add_penalty_grad(
            found.grad,
            scene,
            self.frame.cameras,
            view=view,
            center=self.centers[view],
            extent=self.extent,
            area_price=price,
        )
        self.table.step(dict(found.grad.items()))
        if found.means2d is not None:
            self.statistics = self.statistics.add(found.means2d * self.half_size)
            if iteration >= constants.DENSIFY_FROM and iteration % constants.DENSIFY_EVERY == 0:
                self._densify()
        if self.settings.prune_error > 0 and iteration in [int(n * self.iterations) for n in self.pyramid.prune_at]:
            self._prune()
        self.losses.append(found.loss)

    def _disturbed(self, rows: Gaussians[torch.Tensor]) -> Gaussians[torch.Tensor]:
        """The scene with noise on its centres, through which gradients pass unchanged; as it is without noise."""
        if self.settings.noise == 0:
            return rows
        noise = torch.randn(rows.means.shape, generator=self.generator).to(rows.means.device)
        noise *= self.settings.noise * self.extent
        return replace(rows, means=rows.means + noise)

    def _loss_and_grad(self, view: int, wrt: WrtScene) -> LossAndGrad[Gaussians[torch.Tensor]]:
        """Loss of a view and its gradients, and the exposure step."""
        if self.exposure:
            self.photometric.exposure = self.exposure.exposure
        session = self.renderer.open(wrt.values, None, self.frame.cameras, self.assembly.background)
        found = session.loss_and_grad(view, self.photometric.view_target(view), wrt)
        if self.exposure and found.exposure is not None:
            self.exposure = self.exposure.step(view, found.exposure, lr=0.005, identity_weight=1e-3)
            if sum(self.exposure.steps) % CENTER_EVERY == 0:
                self.exposure = self.exposure.centered()
        return found

    def _area_price(self, iteration: int) -> float:
        """Return the price of covered pixels: 0 after the pruning, so that the others fit the pictures alone."""
        wanted = iteration < self.pyramid.prune_at[0] * self.iterations
        return area_price(self.whole.cameras.width) if wanted else 0.0

    def _densify(self) -> None:
        gaussians = self.gaussians().map(torch.Tensor.detach)
        gradient = constants.DENSIFY_GRADIENT * densify_factor(self.whole.cameras.width)
        limits = GrowthLimits(gradient, self.settings.max_gaussians, self.extent, self.widest)
        edit, values = grow_and_prune(gaussians, self.statistics, limits, self.generator)
        self.table.edit(edit, values)
        self.levels, self.ancestors = self.levels[edit.source], self.ancestors[edit.source]
        self.statistics = DensifyStatistics.zeros(len(self.levels), self.device)

    def _prune(self) -> None:
        """Remove Gaussians that the images would not miss; the others have time to close the gaps."""
        gaussians = self.gaussians().map(torch.Tensor.detach)
        exposure = self.exposure.exposure if self.exposure else self.photometric.exposure
        views = TrainingViews(self.renderer, self.frame, exposure, self.assembly.background)
        least = self.settings.prune_error * prune_factor(self.whole.cameras.width)
        rows = prune_by_error(views, gaussians, self.generator, least)
        self.table.select_rows(rows)
        self.levels, self.ancestors = self.levels[rows], self.ancestors[rows]
        self.statistics = DensifyStatistics.zeros(len(rows), self.device)

    def _next_view(self) -> int:
        if not self.order:
            self.order = torch.randperm(self.views, generator=self.generator).tolist()
        return self.order.pop(0)


def sort_by_node(node_of: torch.Tensor) -> TopologyEdit:
    """Return the permutation that stores Gaussians node by node (stable)."""
    return TopologyEdit.permute(torch.argsort(node_of, stable=True))
