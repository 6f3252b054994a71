"""The renderer `gsplat`. What it returns lies on the device of what it is given; it works on a GPU.

Differences from the reference renderer, all of them gsplat's: the Gaussian that would take the transmittance below
1e-4 is not drawn (at most 1e-4 in colour); exponentials are CUDA's fast ones; sums of gradients run in no fixed order,
so two runs differ in the last digits.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import torch
from pydantic import Field

from gsstream.api import Cameras, Gaussians, PartConfig, ShapeError
from gsstream.backend import Renderer, RenderOutput, RenderSession, ScreenGradient, drawn_rows
from gsstream_gsplat_render.kernels import Kernels, load_kernels
from gsstream_gsplat_render.rig import Background, Rig, Rigs, Target, rigs_on
from gsstream_gsplat_render.splat import Drawn, composite, draw, pixels, project, touched_tiles


@final
class GsplatRenderer(Renderer):
    """CUDA rasteriser through gsplat 1.5; float32 only.

    Raises PluginUnavailable on construction when there is no GPU, no gsplat, or no compiled kernels.
    """

    source = "gsplat (Ye et al. 2024)"

    class Config(PartConfig):
        device: str = Field(default="cuda", pattern=r"^cuda(:\d+)?$", description="the GPU, e.g. cuda or cuda:1")

    def __init__(self, config: PartConfig | None = None) -> None:
        super().__init__(config)
        load_kernels(self.config.device)

    @property
    def device(self) -> torch.device:
        return torch.device(self.config.device)

    def render(
        self, gaussians: Gaussians[torch.Tensor], cameras: Cameras, view: int, background: Background
    ) -> RenderOutput:
        return self.open(gaussians, None, cameras, background).render(view, gaussians)

    def open(
        self, gaussians: Gaussians[torch.Tensor], active: torch.Tensor | None, cameras: Cameras, background: Background
    ) -> RenderSession:
        kernels, rigs = load_kernels(self.config.device), rigs_on(self.config.device)
        return GsplatSession(
            kernels=kernels, rigs=rigs, gaussians=gaussians, active=active, cameras=cameras, background=background
        )


@dataclass(frozen=True, slots=True)
class _Before:
    """A view of the session's scene, and the tiles in which the active rows are drawn in it; None: not known yet."""

    drawn: Drawn
    tiles: torch.Tensor | None


@final
class GsplatSession(RenderSession):
    """One scene on the device, of which some rows change. Tiles that these rows never touch are drawn once.

    Arguments:
        kernels: gsplat's functions.
        rigs: of the renderer, whose device they work on.
        active: [A] rows that change, no duplicates; None: all.
    """

    def __init__(
        self,
        kernels: Kernels,
        rigs: Rigs,
        gaussians: Gaussians[torch.Tensor],
        active: torch.Tensor | None,
        cameras: Cameras,
        background: Background,
    ) -> None:
        self._kernels, self._rigs = kernels, rigs
        self._cameras, self._background = cameras, background
        self._home = gaussians.means.device
        self._scene = _moved(gaussians.map(torch.Tensor.detach), rigs.device)
        self._active: torch.Tensor | None = None
        self._before: dict[int, _Before] = {}
        if active is not None:
            self.narrow(active)

    @property
    def cameras(self) -> Cameras:
        return self._cameras

    def render(
        self,
        view: int,
        rows: Gaussians[torch.Tensor],
        *,
        probe: torch.Tensor | None = None,
        tile_mask: torch.Tensor | None = None,
    ) -> RenderOutput:
        target, home = self._rig[view], rows.means.device
        whole, whole_probe = self._merged(_moved(rows, self._rigs.device), probe)
        mask = None if tile_mask is None else _checked_mask(tile_mask, target).to(self._rigs.device)
        if self._active is None or len(whole) == 0:
            drawn = draw(self._kernels, whole, target, probe=whole_probe, mask=mask)
            return RenderOutput(drawn.image.to(home), drawn.alpha.to(home))
        seen = project(self._kernels, whole, target, whole_probe)
        shown, tiles = self._shown_before(view)
        tiles = tiles | touched_tiles(seen.rows(self._active), target)
        mask = tiles if mask is None else tiles & mask
        drawn, inside = composite(self._kernels, seen, target, mask), pixels(mask, target)
        image = torch.where(inside[..., None], drawn.image, shown.image)
        alpha = torch.where(inside, drawn.alpha, shown.alpha)
        return RenderOutput(image.to(home), alpha.to(home), tiles.to(home))

    def visible(self, view: int, tiles: torch.Tensor) -> torch.Tensor:
        target = self._rig[view]
        size = self._cameras.height, self._cameras.width

        def shown(scene: Gaussians[torch.Tensor]) -> RenderOutput:
            drawn = draw(self._kernels, scene, target)
            return RenderOutput(drawn.image, drawn.alpha)

        return drawn_rows(shown, self._scene, size, tiles.to(self._rigs.device)).to(self._home)

    def narrow(self, active: torch.Tensor) -> None:
        self._active = active.to(self._rigs.device)
        # The pictures stay, which show the scene as it is; the tiles are those of other rows.
        self._before = {view: replace(before, tiles=None) for view, before in self._before.items()}

    def commit(self, gaussians: Gaussians[torch.Tensor], changed: torch.Tensor) -> RenderSession:
        return GsplatSession(
            kernels=self._kernels,
            rigs=self._rigs,
            gaussians=gaussians,
            active=None,
            cameras=self._cameras,
            background=self._background,
        )

    def screen_gradient(self, view: int, image_gradient: torch.Tensor) -> ScreenGradient:
        """By a scene on black, so the background has no share in it."""
        target = self._rigs.find(self._cameras, (0.0, 0.0, 0.0))[view]
        if len(self._scene) == 0:
            none = self._scene.means[:, :2].to(self._home)
            return ScreenGradient(none, none[:, 0] > 0)
        probe = torch.zeros_like(self._scene.means[:, :2]).requires_grad_()
        with torch.enable_grad():
            seen = project(self._kernels, self._scene, target, probe)
            drawn = composite(self._kernels, seen, target)
            (gradient,) = torch.autograd.grad(drawn.image, probe, image_gradient.to(self._rigs.device).float())
        return ScreenGradient(gradient.to(self._home), seen.visible.to(self._home))

    @property
    def _rig(self) -> Rig:
        return self._rigs.find(self._cameras, self._background)

    def _merged(
        self, rows: Gaussians[torch.Tensor], probe: torch.Tensor | None
    ) -> tuple[Gaussians[torch.Tensor], torch.Tensor | None]:
        """The whole scene with these active rows, and their probe among zeros."""
        moved = None if probe is None else probe.to(self._rigs.device)
        if self._active is None:
            return rows, moved
        base, active = dict(self._scene.items()), self._active
        whole = Gaussians(**{name: base[name].index_copy(0, active, value) for name, value in rows.items()})
        if moved is None:
            return whole, None
        return whole, moved.new_zeros(len(whole), 2).index_copy(0, active, moved)

    def _shown_before(self, view: int) -> tuple[Drawn, torch.Tensor]:
        """The view of the session's scene, and the tiles in which the active rows are drawn in it."""
        known = self._before.get(view)
        if known is not None and known.tiles is not None:
            return known.drawn, known.tiles
        assert self._active is not None
        with torch.no_grad():
            seen = project(self._kernels, self._scene, self._rig[view])
            drawn = known.drawn if known else composite(self._kernels, seen, self._rig[view])
            tiles = touched_tiles(seen.rows(self._active), self._rig[view])
        self._before[view] = _Before(drawn, tiles)
        return drawn, tiles


def _moved(gaussians: Gaussians[torch.Tensor], device: torch.device) -> Gaussians[torch.Tensor]:
    for name, value in gaussians.items():
        if value.dtype != torch.float32:
            raise ShapeError(f"{name}: expected dtype torch.float32, got {value.dtype}; convert it with .float()")
    return gaussians.map(lambda value: value.to(device))


def _checked_mask(mask: torch.Tensor, where: Target) -> torch.Tensor:
    if mask.dtype != torch.bool or tuple(mask.shape) != where.tiles:
        raise ShapeError(f"tile_mask: expected bool {list(where.tiles)}, got {mask.dtype} {list(mask.shape)}")
    return mask
