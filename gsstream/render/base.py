"""Renderer: Gaussians and one camera in, an image and gradients out.

Conventions: pixel-corner origin, 0.3 px screen-space blur, alpha cut at 1/255, alpha clamped at 0.999, a Gaussian
counts while the transmittance before it exceeds 1e-4, near plane ``cameras.near``. Tiles are 16 x 16 pixels.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace

import torch

from gsstream.core.cameras import Cameras
from gsstream.core.changes.motion import Moves
from gsstream.core.context import ScreenGradient
from gsstream.core.errors import ShapeError
from gsstream.core.gaussians import Gaussians
from gsstream.core.part import Part
from gsstream.core.shapes import FloatArray
from gsstream.render.output import TILE as TILE
from gsstream.render.output import Comparison as Comparison
from gsstream.render.output import Pulled as Pulled
from gsstream.render.output import RenderCache as RenderCache
from gsstream.render.output import RenderOutput as RenderOutput


class RenderSession(ABC):
    """Renders a scene of which only some rows change, from a fixed rig.

    A session begins wide: every row may change. ``narrow`` says which rows change from then on; all others stay as they
    are in the session's scene. ``commit`` ends a frame: it gives the session of the next scene, wide again, which
    renders and differentiates exactly as one opened anew would, and in which a renderer may keep whatever did not
    change. ``screen_gradient`` and ``visible`` belong to the session's scene and may be asked for at any time.
    """

    @abstractmethod
    def render(
        self,
        view: int,
        rows: Gaussians[torch.Tensor],
        *,
        probe: torch.Tensor | None = None,
        tile_mask: torch.Tensor | None = None,
    ) -> RenderOutput:
        """Render camera ``view``, differentiably.

        Arguments:
            view: index of a camera of the rig.
            rows: the A active rows, raw parameters; all N of a session that was not narrowed.
            probe: [A, 2] zeros that require grad; its gradient is the gradient of the 2-D means in pixels.
            tile_mask: [ceil(H / 16), ceil(W / 16)] bool; None renders everything. Inside, image and alpha are those
                of the scene with these rows, and gradients are sums over these pixels alone. Outside, a narrowed
                session shows its scene as it was before these rows changed, or, where it keeps no cache, the scene with
                these rows; so a mask must cover what the rows touch and touched, and an SSIM window that looks beyond
                it sees the right picture. Outside, the gradient of the image is taken as zero.
        """

    @abstractmethod
    def screen_gradient(self, view: int, image_gradient: torch.Tensor) -> ScreenGradient:
        """Pull an upstream image gradient [H, W, 3] back to the 2-D means (pixels) of the session's scene.

        What this projects and sorts, ``render`` need not do again. Where the gradient is zero in most of the image, a
        renderer may spend work only on the rest.
        """

    @abstractmethod
    def visible(self, view: int, tiles: torch.Tensor) -> torch.Tensor:
        """Say which Gaussians of the session's scene are drawn in the marked tiles of camera ``view``.

        A Gaussian is drawn at a pixel when it lies behind the near plane, its alpha at the pixel's centre is at least
        1/255, and the transmittance before it exceeds 1e-4: exactly then it adds light to the pixel. Its colour does
        not matter; a black Gaussian on black is drawn. Two answers may differ in rows whose alpha or transmittance lies
        at its bound within rounding. A renderer that draws whole blocks of pixels may count those that lie in a marked
        tile beyond the image's edge. Nothing is differentiated; the work of a renderer that keeps a cache follows the
        marked tiles once the view's cache is filled.

        Arguments:
            view: index of a camera of the rig.
            tiles: [ceil(H / 16), ceil(W / 16)] bool, the tiles that are asked about.

        Returns:
            [N] bool, one per Gaussian of the session's scene, active or not.

        Raises:
            ShapeError: ``tiles`` of another shape or dtype.
        """

    @abstractmethod
    def narrow(self, active: torch.Tensor) -> None:
        """Freeze all rows but ``active`` [A], ascending. Replaces an earlier choice."""

    def pull(self, view: int, rows: Gaussians[torch.Tensor], comparison: Comparison) -> Pulled | None:
        """Render camera ``view``, compare it and differentiate, in one call; None where there is no such short cut.

        It stands for ``render``, the loss's ``evaluate`` on the tiles that the rows can change, and the backward pass,
        whose results it gives up to rounding; whoever gets None makes these calls.

        Arguments:
            view: index of a camera of the rig.
            rows: the A active rows, raw parameters; no graph is looked at.
            comparison: what the render is compared with.

        Raises:
            ShapeError: rows that cannot be rendered, or a loss that is not finite.
        """
        return None

    def pull_moved(
        self, view: int, rows: Gaussians[FloatArray], moves: Moves, comparison: Comparison
    ) -> tuple[float, FloatArray] | None:
        """Render rows after their groups moved, compare, and pull the loss back to the groups, in one call.

        None where there is no such short cut, or it finds a fault: whoever asks then makes the calls that it stands for
        (``gsstream.blocks.slope_of``), which raise the error. Results are theirs up to rounding.

        Arguments:
            view: index of a camera of the rig.
            rows: the A active rows before they move, raw parameters.
            moves: of these rows, which it counts from 0 to A - 1.
            comparison: what the render is compared with.

        Returns:
            The loss, and its gradient [K, 6] by the groups' shift and turn.
        """
        return None

    def commit(self, gaussians: Gaussians[torch.Tensor], changed: torch.Tensor) -> RenderSession:
        """Return the session of the next scene, equal bit for bit to one opened anew with ``gaussians``.

        No row of it is frozen.

        This session gives its caches away; it stays correct, but has to fill them again. Backward through what it
        rendered is no longer possible. Call it when nothing can fail any more, with decoded values: a frame that failed
        after rendering changed nothing here, its session can be kept or dropped.

        Arguments:
            gaussians: the whole next scene, as many rows as now; not copied, so never change it in place.
            changed: [A] int64 rows in which it may differ from the session's scene, whether they were active or not;
                in no other row may it differ. May be empty.

        Raises:
            InputError: another number of rows, values that are not finite.
            NotImplementedError: the renderer was built before sessions could go on; install its plugin again.
        """
        raise NotImplementedError(
            f"{type(self).__name__} has no method 'commit' to go on to the next frame; install its plugin again"
        )

    def cache_bytes(self) -> RenderCache:
        """Return what is kept for the cameras; empty for a renderer that caches nothing."""
        return RenderCache()


class Renderer(Part):
    """A differentiable rasteriser."""

    @abstractmethod
    def render(
        self, gaussians: Gaussians[torch.Tensor], cameras: Cameras, view: int, background: tuple[float, float, float]
    ) -> RenderOutput:
        """Render one camera of the rig; differentiable in every attribute.

        Arguments:
            gaussians: N rows, raw values. cameras: the rig.
            view: index of one of its cameras. background: colour behind everything, 0 to 1.
        """

    def screen_gradient(
        self, gaussians: Gaussians[torch.Tensor], cameras: Cameras, view: int, image_gradient: torch.Tensor
    ) -> ScreenGradient:
        """Pull an upstream image gradient [H, W, 3] back to the 2-D means (pixels) of a scene on black.

        By default a session is asked. A renderer that opens a ``ScatterSession`` overrides this method: that session
        asks its renderer.

        Arguments:
            gaussians: N rows, raw values. cameras: the rig.
            view: index of one of its cameras. image_gradient: [H, W, 3].

        Raises:
            NotImplementedError: neither the renderer nor its session knows the gradient of the 2-D means.
        """
        session = self.open(gaussians, None, cameras, (0.0, 0.0, 0.0))
        if type(session).screen_gradient is ScatterSession.screen_gradient:
            name = type(self).__name__
            raise NotImplementedError(
                f"{name}: expected 'screen_gradient', or an 'open' whose session has its own, got neither; write one"
            )
        return session.screen_gradient(view, image_gradient)

    def open(
        self,
        gaussians: Gaussians[torch.Tensor],
        active: torch.Tensor | None,
        cameras: Cameras,
        background: tuple[float, float, float],
    ) -> RenderSession:
        """Open a session in which only the rows ``active`` [A] (None: all) change. Renderers may cache the rest.

        Arguments:
            gaussians: N rows, raw values. active: [A] rows that change, ascending; None: all.
            cameras: the rig. background: colour behind everything, 0 to 1.
        """
        return ScatterSession(self, gaussians, active, cameras, background)


class ScatterSession(RenderSession):
    """The session every renderer has: put the active rows back and render everything."""

    def __init__(
        self,
        renderer: Renderer,
        gaussians: Gaussians[torch.Tensor],
        active: torch.Tensor | None,
        cameras: Cameras,
        background: tuple[float, float, float],
    ) -> None:
        self._renderer, self._gaussians, self._active = renderer, gaussians, active
        self._cameras, self._background = cameras, background

    def render(
        self,
        view: int,
        rows: Gaussians[torch.Tensor],
        *,
        probe: torch.Tensor | None = None,
        tile_mask: torch.Tensor | None = None,
    ) -> RenderOutput:
        if probe is not None:
            name = type(self._renderer).__name__
            raise NotImplementedError(f"{name} offers no gradient of the 2-D means in a session")
        return self._renderer.render(self._whole(rows), self._cameras, view, self._background)

    def _whole(self, rows: Gaussians[torch.Tensor]) -> Gaussians[torch.Tensor]:
        """The session's scene with the active rows put into their places."""
        if self._active is None:
            return rows
        base = dict(self._gaussians.items())
        return Gaussians(**{n: base[n].index_copy(0, self._active, value) for n, value in rows.items()})

    def screen_gradient(self, view: int, image_gradient: torch.Tensor) -> ScreenGradient:
        return self._renderer.screen_gradient(self._gaussians, self._cameras, view, image_gradient)

    def visible(self, view: int, tiles: torch.Tensor) -> torch.Tensor:
        size = self._cameras.height, self._cameras.width
        scene = self._gaussians
        return drawn_rows(lambda g: self._renderer.render(g, self._cameras, view, (0.0,) * 3), scene, size, tiles)

    def narrow(self, active: torch.Tensor) -> None:
        self._active = active

    def commit(self, gaussians: Gaussians[torch.Tensor], changed: torch.Tensor) -> RenderSession:
        return self._renderer.open(gaussians, None, self._cameras, self._background)


def drawn_rows(
    render: Callable[[Gaussians[torch.Tensor]], RenderOutput],
    gaussians: Gaussians[torch.Tensor],
    size: tuple[int, int],
    tiles: torch.Tensor,
) -> torch.Tensor:
    """Find by differentiation who is drawn in marked tiles: ``RenderSession.visible`` of any differentiable renderer.

    The derivative of the image by the colour of a Gaussian is the sum of its weights alpha * transmittance, which are
    positive where it is drawn and zero elsewhere, so nothing can cancel. All are drawn in grey, because a colour that
    is clamped at 0 has no derivative.

    Arguments:
        render: draws a whole scene; differentiable by its colours. gaussians: the scene, N rows.
        size: (H, W) of the image, pixels. tiles: [ceil(H / 16), ceil(W / 16)] bool.

    Returns:
        [N] bool.

    Raises:
        ShapeError: ``tiles`` of another shape or dtype.
    """
    check_tiles(tiles, size)
    inside = tiles.repeat_interleave(TILE, 0).repeat_interleave(TILE, 1)[: size[0], : size[1]]
    fixed = gaussians.map(torch.Tensor.detach)
    colours = torch.zeros_like(fixed.sh0).requires_grad_()
    with torch.enable_grad():
        image = render(replace(fixed, sh0=colours, shN=torch.zeros_like(fixed.shN))).image
        if not image.requires_grad:  # nothing is drawn at all
            return torch.zeros(len(fixed), dtype=torch.bool)
        (weights,) = torch.autograd.grad(image, colours, inside[..., None].expand_as(image).to(image.dtype))
    return (weights > 0).flatten(1).any(1)


def check_tiles(tiles: torch.Tensor, size: tuple[int, int]) -> None:
    """Raise ShapeError unless ``tiles`` is bool [ceil(H / 16), ceil(W / 16)] for an image of ``size`` (H, W)."""
    wanted = [-(-side // TILE) for side in size]
    if tiles.dtype != torch.bool or list(tiles.shape) != wanted:
        raise ShapeError(
            f"tiles: expected bool {wanted} ({TILE} x {TILE} pixel tiles of a {size[1]} x {size[0]} image), got "
            f"{tiles.dtype} {list(tiles.shape)}; give one mark per tile"
        )
