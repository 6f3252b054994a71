"""One scene of which some rows change, drawn by gsplat's functions, operation by operation or replayed."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from copy import copy
from typing import Any, NamedTuple, final

import torch

from gsstream.api import Cameras, Gaussians, ShapeError
from gsstream.backend import RenderOutput, RenderSession, ScreenGradient, check_tiles
from gsstream.replay import RecordError, Records, ReplayedSession, SeenView
from gsstream_gsplat_render.kernels import Kernels
from gsstream_gsplat_render.placed import Placed
from gsstream_gsplat_render.rig import Background, Rig, Rigs, Target
from gsstream_gsplat_render.seen import Projected
from gsstream_gsplat_render.splat import (
    Drawn,
    Pasted,
    composite,
    composite_fixed,
    draw_nothing,
    draw_views,
    pixels,
    project,
    rows_in_tiles,
)
from gsstream_gsplat_render.tiles import Grid


class Shown(NamedTuple):
    """A view of the session's scene: image [H, W, 3], alpha [H, W].

    ``tiles``: in which the active rows are drawn, as ``Grid.covered`` gives them.
    """

    image: torch.Tensor
    alpha: torch.Tensor
    tiles: torch.Tensor


class Own(NamedTuple):
    """What a view is drawn from besides the rows; ``shown``: None where every row changes."""

    target: Target
    shown: Shown | None
    grid: Grid


class _Scatter(NamedTuple):
    """A scene, a view, and the gradient by its image [H, W, 3].

    ``grid``: None: lists are as long as they have to be.
    """

    scene: Gaussians[torch.Tensor]
    target: Target
    upstream: torch.Tensor
    grid: Grid | None


SCATTERED = "gradients on the screen"
#: Pixels, and Gaussians times views, of one call that draws several views.
PIXELS, ROWS = 1 << 24, 1 << 23


@final
class GsplatSession(ReplayedSession):
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
        #: Of each view the image, its alpha, and the boxes of the Gaussians.
        self._pictures: dict[int, tuple[torch.Tensor, ...]] = {}
        self._tiles: dict[int, torch.Tensor] = {}
        #: Of what the active rows make, and the tables of the scene that these rows are put into meanwhile.
        self._records: Records | None = None
        self._tables: tuple[torch.Tensor, ...] | None = None
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
        home, (target, shown, grid) = rows.means.device, self.own(view)
        whole, whole_probe = self._merged(_moved(rows, self._rigs.device), probe)
        mask = None if tile_mask is None else grid.padded(_checked_mask(tile_mask, target).to(self._rigs.device))
        if len(whole) == 0:
            drawn = draw_nothing(target)
            return RenderOutput(drawn.image.to(home), drawn.alpha.to(home))
        seen = project(self._kernels, whole, target, grid, probe=whole_probe)
        if shown is None:
            drawn = self._composited(seen, target, mask)
            alpha = drawn.alpha
            if mask is not None and self.fixed is None:
                alpha = torch.where(pixels(mask, target), alpha, torch.zeros_like(alpha))
            return RenderOutput(drawn.image.to(home), alpha.to(home))
        assert self._active is not None
        tiles = grid.covered(seen.boxes, self._active, shown.tiles)
        mask = tiles if mask is None else tiles & mask
        drawn, inside = self._composited(seen, target, mask), pixels(mask, target)
        image: torch.Tensor = Pasted.apply(drawn.image, shown.image, inside)  # type: ignore[no-untyped-call]
        # What is recorded is a loss, which reads no alpha.
        alpha = drawn.alpha if self.fixed is not None else torch.where(inside, drawn.alpha, shown.alpha)
        return RenderOutput(image.to(home), alpha.to(home), tiles[:-1].to(home))

    def visible(self, view: int, tiles: torch.Tensor) -> torch.Tensor:
        check_tiles(tiles, (self._cameras.height, self._cameras.width))
        return self._drawn_in([view], tiles[None])

    def visible_anywhere(self, tiles: torch.Tensor) -> torch.Tensor:
        for each in tiles:
            check_tiles(each, (self._cameras.height, self._cameras.width))
        # A camera without a marked tile has no say, and need not be projected into.
        views = tiles.flatten(1).any(1).cpu().nonzero()[:, 0].tolist()
        return self._drawn_in(views, tiles if len(views) == len(tiles) else tiles[views])

    def _drawn_in(self, views: Sequence[int], tiles: torch.Tensor) -> torch.Tensor:
        """[N] bool: drawn in the marked tiles [V, rows, columns] of any of these views."""
        there = tiles.to(self._rigs.device)
        drawn = torch.zeros_like(self._scene.opacities, dtype=torch.bool)
        if len(self._scene):
            for some in self._at_once(len(views)):
                together = self._rig.together(views[some])
                drawn = drawn | rows_in_tiles(self._kernels, self._scene, together, there[some])
        return drawn.to(self._home)

    def _at_once(self, count: int) -> list[slice]:
        """So many views are drawn in one call that memory is bounded."""
        size = self._cameras.height * self._cameras.width
        step = max(1, min(PIXELS // size, ROWS // max(1, len(self._scene))))
        return [slice(at, at + step) for at in range(0, count, step)]

    def narrow(self, active: torch.Tensor) -> None:
        self._active = active.to(self._rigs.device)
        # The pictures stay, which show the scene as it is; the tiles are those of other rows.
        self._tiles, self._records, self._tables = {}, None, None

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
        rig, place = self._rigs.find(self._cameras, (0.0, 0.0, 0.0)), self._rigs.device
        if len(self._scene) == 0:
            none = self._scene.means[:, :2].to(self._home)
            return ScreenGradient(none, none[:, 0] > 0)
        upstream = image_gradient.to(place).float()
        records, found = rig.records if self._home == place else None, None
        if records is not None and rig.is_measured and records.can(SCATTERED):
            with suppress(RecordError):
                asked = _Scatter(self._scene, rig[view], upstream, rig.grid)
                found = records.call(SCATTERED, self._scatter, asked)
        if found is None:
            found = self._scatter(_Scatter(self._scene, rig[view], upstream, None))
        return ScreenGradient(found.gradient.to(self._home), found.visible.to(self._home))

    def _scatter(self, asked: _Scatter) -> ScreenGradient:
        """Of the scene that is handed over, and nothing else of this session: its record serves others."""
        (scene, target, upstream, grid), rig = asked, self._rigs.find(self._cameras, (0.0, 0.0, 0.0))
        probe = torch.zeros_like(scene.means[:, :2]).requires_grad_()
        with torch.enable_grad():
            seen = project(self._kernels, scene, target, grid or rig.grid, probe=probe)
            if grid is None:
                drawn = composite(self._kernels, seen, target)
                rig.count(drawn.entries)
            else:
                drawn = composite_fixed(self._kernels, seen, target, grid)
            (gradient,) = torch.autograd.grad(drawn.image, probe, upstream)
        return ScreenGradient(gradient, seen.visible)

    @property
    def records(self) -> Records | None:
        rig = self._rig
        if rig.recorder is None or self._home != self._rigs.device or len(self._scene) == 0:
            return None
        if self._active is None:  # the scene is handed over with every call, so all sessions of the rig do the same
            return rig.records if rig.is_measured else None
        if self._records is None:
            self._records = Records(rig.recorder, room=rig)
            self._tables = tuple(value.clone() for _, value in self._scene.items())
        return self._records

    def own(self, view: int) -> Own:
        if self.fixed is not None:
            own: Own = self.fixed.own
            return own
        shown = None if self._active is None or len(self._scene) == 0 else self._shown_before(view)
        return Own(self._rig[view], shown, self._rig.grid)

    def numbers(self, view: int) -> torch.Tensor:
        return self._rig.numbers(view)

    def drawing(self, seen: SeenView) -> GsplatSession:
        drawing = copy(self)
        drawing.fixed = seen
        return drawing

    def _composited(self, seen: Projected, target: Target, mask: torch.Tensor | None = None) -> Drawn:
        """A view, with lists of fixed size where that is what is recorded."""
        if self.fixed is not None:
            return composite_fixed(self._kernels, seen, target, self.fixed.own.grid, mask=mask)
        drawn = composite(self._kernels, seen, target, mask)
        self._rig.count(drawn.entries)
        return drawn

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
        if self.fixed is not None and self._tables is not None:
            values = [getattr(rows, name) for name in base]
            placed: Any = Placed.apply(self._rigs.rows, active, self._tables, *values)  # type: ignore[no-untyped-call]
            whole = Gaussians(**dict(zip(base, placed, strict=True)))
        else:
            whole = Gaussians(**{name: base[name].index_copy(0, active, value) for name, value in rows.items()})
        return whole, None if moved is None else moved.new_zeros(len(whole), 2).index_copy(0, active, moved)

    def _shown_before(self, view: int) -> Shown:
        """The view of the session's scene, and the tiles in which the active rows are drawn in it."""
        assert self._active is not None
        if view not in self._pictures:
            # A pass asks for every view.
            some = next(each for each in self._at_once(len(self._cameras)) if each.start <= view < each.stop)
            views = range(len(self._cameras))[some]
            found = draw_views(self._kernels, self._scene, self._rig.together(views), self._rig.grid)
            self._rig.count(found.entries)
            self._pictures.update(zip(views, zip(found.image, found.alpha, found.boxes, strict=True), strict=True))
        image, alpha, boxes = self._pictures[view]
        if view not in self._tiles:
            self._tiles[view] = self._rig.grid.covered(boxes, self._active)
        return Shown(image, alpha, self._tiles[view])


def _moved(gaussians: Gaussians[torch.Tensor], device: torch.device) -> Gaussians[torch.Tensor]:
    for name, value in gaussians.items():
        if value.dtype != torch.float32:
            raise ShapeError(f"{name}: expected dtype torch.float32, got {value.dtype}; convert it with .float()")
    return gaussians.map(lambda value: value.to(device))


def _checked_mask(mask: torch.Tensor, where: Target) -> torch.Tensor:
    if mask.dtype != torch.bool or tuple(mask.shape) != where.tiles:
        raise ShapeError(f"tile_mask: expected bool {list(where.tiles)}, got {mask.dtype} {list(mask.shape)}")
    return mask
