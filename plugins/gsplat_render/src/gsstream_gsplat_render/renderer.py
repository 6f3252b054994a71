"""The renderer `gsplat`. The engine's tensors live on the CPU: rows go to the GPU and images come back at this border.

Differences from the reference renderer, all of them gsplat's: the Gaussian that would take the transmittance below
1e-4 is not drawn (at most 1e-4 in colour); exponentials are CUDA's fast ones; sums of gradients run in no fixed order,
so two runs differ in the last digits.
"""

from __future__ import annotations

from typing import final

import torch
from pydantic import Field

from gsstream.api import (
    Cameras,
    Gaussians,
    PartConfig,
    Renderer,
    RenderOutput,
    RenderSession,
    ScreenGradient,
    ShapeError,
    drawn_rows,
)
from gsstream_gsplat_render.kernels import Kernels, load_kernels
from gsstream_gsplat_render.splat import Background, Drawn, Target, draw, pixels, target


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

    def render(
        self, gaussians: Gaussians[torch.Tensor], cameras: Cameras, view: int, background: Background
    ) -> RenderOutput:
        return GsplatSession(self._kernels, self.config.device, gaussians, None, cameras, background).render(
            view, gaussians
        )

    def open(
        self,
        gaussians: Gaussians[torch.Tensor],
        active: torch.Tensor | None,
        cameras: Cameras,
        background: Background,
    ) -> RenderSession:
        return GsplatSession(self._kernels, self.config.device, gaussians, active, cameras, background)

    @property
    def _kernels(self) -> Kernels:
        return load_kernels(self.config.device)


@final
class GsplatSession(RenderSession):
    """One frame step: frozen rows stay on the device, only active rows travel.

    Arguments:
        active: [A] rows that change, no duplicates; None: all.
        device: where ``kernels`` work.
    """

    def __init__(
        self,
        kernels: Kernels,
        device: str,
        gaussians: Gaussians[torch.Tensor],
        active: torch.Tensor | None,
        cameras: Cameras,
        background: Background,
    ) -> None:
        self._kernels, self._device = kernels, device
        self._cameras, self._background = cameras, background
        self._gaussians = gaussians
        self._active: torch.Tensor | None = None
        self._frozen: Gaussians[torch.Tensor] | None = None
        if active is not None:
            self.narrow(active)
        self._targets: dict[int, Target] = {}
        self._cached: dict[int, Drawn] = {}

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
        where = self._target(view)
        whole, whole_probe = self._merged(_moved(rows, self._device), probe)
        mask = None if tile_mask is None else _checked_mask(tile_mask, where).to(self._device)
        drawn = draw(self._kernels, whole, where, whole_probe, mask)
        image, alpha = drawn.image, drawn.alpha
        if mask is not None and self._frozen is not None:
            cached, inside = self._cache(view), pixels(mask, where)
            image = torch.where(inside[..., None], image, cached.image)
            alpha = torch.where(inside, alpha, cached.alpha)
        return RenderOutput(image.cpu(), alpha.cpu())

    def visible(self, view: int, tiles: torch.Tensor) -> torch.Tensor:
        wide = GsplatSession(self._kernels, self._device, self._gaussians, None, self._cameras, self._background)
        size = self._cameras.height, self._cameras.width
        return drawn_rows(lambda scene: wide.render(view, scene), self._gaussians, size, tiles)

    def narrow(self, active: torch.Tensor) -> None:
        self._active = active.to(self._device)
        self._frozen = _moved(self._gaussians.map(torch.Tensor.detach), self._device)

    def commit(self, gaussians: Gaussians[torch.Tensor], changed: torch.Tensor) -> RenderSession:
        return GsplatSession(self._kernels, self._device, gaussians, None, self._cameras, self._background)

    def screen_gradient(self, view: int, image_gradient: torch.Tensor) -> ScreenGradient:
        return screen_gradient(
            self._kernels, self._device, self._gaussians, self._cameras, view, image_gradient
        )

    def _merged(
        self, rows: Gaussians[torch.Tensor], probe: torch.Tensor | None
    ) -> tuple[Gaussians[torch.Tensor], torch.Tensor | None]:
        """The whole scene with these active rows, and their probe among zeros."""
        moved = None if probe is None else probe.to(self._device)
        if self._frozen is None or self._active is None:
            return rows, moved
        base, active = dict(self._frozen.items()), self._active
        whole = Gaussians(**{name: base[name].index_copy(0, active, value) for name, value in rows.items()})
        if moved is None:
            return whole, None
        return whole, moved.new_zeros(len(whole), 2).index_copy(0, active, moved)

    def _target(self, view: int) -> Target:
        if view not in self._targets:
            self._targets[view] = target(self._cameras, view, self._background, self._device)
        return self._targets[view]

    def _cache(self, view: int) -> Drawn:
        """The render of the scene as it was when the session opened."""
        if view not in self._cached:
            assert self._frozen is not None
            with torch.no_grad():
                self._cached[view] = draw(self._kernels, self._frozen, self._target(view))
        return self._cached[view]


def screen_gradient(
    kernels: Kernels,
    device: str,
    gaussians: Gaussians[torch.Tensor],
    cameras: Cameras,
    view: int,
    image_gradient: torch.Tensor,
) -> ScreenGradient:
    """Gradient of sum(image_gradient * image) by the 2-D means, pixels, and which Gaussians touch the image."""
    fixed = _moved(gaussians.map(torch.Tensor.detach), device)
    probe = torch.zeros(len(fixed), 2, device=device, requires_grad=True)
    with torch.enable_grad():
        drawn = draw(kernels, fixed, target(cameras, view, (0.0, 0.0, 0.0), device), probe)
        if not drawn.image.requires_grad:
            return ScreenGradient(torch.zeros(len(fixed), 2), drawn.visible.cpu())
        (gradient,) = torch.autograd.grad((drawn.image * image_gradient.to(device)).sum(), probe)
    return ScreenGradient(gradient.cpu(), drawn.visible.cpu())


def _moved(gaussians: Gaussians[torch.Tensor], device: str) -> Gaussians[torch.Tensor]:
    for name, value in gaussians.items():
        if value.dtype != torch.float32:
            raise ShapeError(f"{name}: expected dtype torch.float32, got {value.dtype}; convert it with .float()")
    return gaussians.map(lambda value: value.to(device))


def _checked_mask(mask: torch.Tensor, where: Target) -> torch.Tensor:
    if mask.dtype != torch.bool or tuple(mask.shape) != where.tiles:
        raise ShapeError(f"tile_mask: expected bool {list(where.tiles)}, got {mask.dtype} {list(mask.shape)}")
    return mask
