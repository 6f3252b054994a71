"""RenderSession: one scene of which some rows change, seen by one rig."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field

import torch

from gsstream.core.cameras import Cameras
from gsstream.core.changes.motion import GroupTransforms
from gsstream.core.context import RowGradient, ScreenGradient
from gsstream.core.deferred import require
from gsstream.core.errors import ShapeError
from gsstream.core.gaussians import SH0, Gaussians
from gsstream.parts.render.backward import backward, gradient_of
from gsstream.parts.render.images import float_image, spread_to_pixels
from gsstream.parts.render.target import ViewTarget
from gsstream.parts.render.transforms import Pinhole, curvature_of, weighted_structure_tensor
from gsstream.parts.render.wrt import G, LossAndGrad, Wrt, WrtTransforms


@dataclass(frozen=True, slots=True)
class RenderOutput:
    """One rendered view.

    Arguments:
        image: [H, W, 3] composited colour; with a tile mask only active tiles are defined (others hold the cached
            render in a session, the background elsewhere).
        alpha: [H, W] 1 - transmittance.
        tiles: [ceil(H / 16), ceil(W / 16)] bool, in a session: the tiles that the active rows are in, now or as the
            session was opened. All others hold the same image in every render of the session. None: any may differ.
    """

    image: torch.Tensor
    alpha: torch.Tensor
    tiles: torch.Tensor | None = None


@dataclass(frozen=True, slots=True)
class RenderCache:
    """Memory a session keeps for its cameras.

    Arguments:
        per_view: bytes of each view that is cached, scratch and images included; views drawn anew each time are absent.
        gaussians: N of the scene.
    """

    per_view: Mapping[int, int] = field(default_factory=dict)
    gaussians: int = 0

    @property
    def total(self) -> int:
        """Bytes of all views."""
        return sum(self.per_view.values())

    @property
    def per_camera_and_gaussian(self) -> float:
        """Bytes per cached camera and Gaussian; 0 where nothing is cached."""
        count = len(self.per_view) * self.gaussians
        return self.total / count if count else 0.0


class RenderSession(ABC):
    """Renders a scene of which only some rows change, from a fixed rig.

    In a new session every row may change. ``narrow`` restricts that to some rows; all others stay as they are in the
    session's scene. ``commit`` ends a frame: it gives the session of the next scene, in which all may change, and which
    renders and differentiates exactly as one opened anew would, and in which a renderer may keep whatever did not
    change. ``screen_gradient`` and ``visible`` belong to the session's scene and may be asked for at any time.
    """

    @property
    @abstractmethod
    def cameras(self) -> Cameras:
        """The rig."""

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
        """Backpropagate an upstream image gradient [H, W, 3] to the 2-D means (pixels) of the session's scene.

        What this projects and sorts, ``render`` need not do again. Where the gradient is zero in most of the image, a
        renderer may spend work only on the rest.
        """

    def screen_gradient_rows(self, view: int, image_gradient: torch.Tensor) -> RowGradient:
        """Return what :meth:`screen_gradient` does of the rows that it reaches; all others have a gradient of zero.

        For a renderer whose work follows the pixels at which the image's gradient is not zero; it may also name rows
        that these pixels do not reach.
        """
        found = self.screen_gradient(view, image_gradient)
        if found.visible.device.type != "cpu":  # to count those that are seen, a GPU is waited for
            return RowGradient(torch.arange(len(found.gradient), device=found.visible.device), found.gradient)
        rows = found.visible.nonzero()[:, 0]
        return RowGradient(rows, found.gradient[rows])

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

    def visible_anywhere(self, tiles: torch.Tensor) -> torch.Tensor:
        """Say which Gaussians are drawn in the marked tiles of any camera: ``visible``, camera by camera.

        A renderer may ask its cameras at the same time.

        Arguments:
            tiles: [V, ceil(H / 16), ceil(W / 16)] bool, the tiles of each camera of the rig.

        Returns:
            [N] bool; no Gaussian where no tile is marked.

        Raises:
            ShapeError: tiles of another shape or dtype.
        """
        # A camera without a marked tile has no say, and need not be projected into.
        first, *others = tiles.flatten(1).any(1).cpu().nonzero()[:, 0].tolist() or [0]
        drawn = self.visible(first, tiles[first])
        for view in others:
            drawn = drawn | self.visible(view, tiles[view])
        return drawn

    @abstractmethod
    def narrow(self, active: torch.Tensor) -> None:
        """Freeze all rows but ``active`` [A], ascending. Replaces an earlier choice."""

    def loss_and_grad(self, view: int, target: ViewTarget, wrt: Wrt[G]) -> LossAndGrad[G]:
        """Render camera ``view``, compare it with what it recorded, and differentiate.

        This body is the truth. A renderer may override it with one that does the same in one call, up to rounding, and
        calls this one for whatever that one does not cover.

        Arguments:
            view: index of a camera of the rig.
            target: what the render is compared with.
            wrt: what is rendered, and differentiated by; no graph of its values is looked at, no ``grad`` written.

        Raises:
            ShapeError: rows that cannot be rendered, or a loss that is not finite.
            NotImplementedError: 2-D means are asked for and ``render`` takes no probe.
        """
        leaves = wrt.placed().map(lambda value: value.detach().requires_grad_())
        probe = leaves.means.new_zeros(len(leaves), 2).requires_grad_() if wrt.means2d else None
        wanted = None if target.tile_weights is None else target.tile_weights > 0
        output = self.render(view, leaves, probe=probe, tile_mask=wanted)
        loss, upstream = _compared(output, target, wanted)
        exposure, image = target.exposure, output.image
        curvature = None
        if isinstance(wrt, WrtTransforms) and wrt.curvature:
            curvature = _curvature(self, view, target, transforms=wrt.transforms, leaves=leaves, image=image)
        backward([image], [exposure.vjp(upstream) if exposure else upstream])
        by_exposure = exposure.grad(image.detach(), upstream) if exposure and wrt.exposure else None
        by_probe = None if probe is None else gradient_of(probe)
        return LossAndGrad(
            loss=loss, grad=wrt.grad(leaves), curvature=curvature, means2d=by_probe, exposure=by_exposure
        )

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

    def pinhole(self, view: int) -> Pinhole:
        """Return a camera; a session on a device may give tensors that are there already."""
        return Pinhole.of(self.cameras, view)

    def cache_bytes(self) -> RenderCache:
        """Return what is kept for the cameras; empty for a renderer that caches nothing."""
        return RenderCache()


def _compared(
    output: RenderOutput, target: ViewTarget, wanted: torch.Tensor | None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Loss [] and gradient [H, W, 3] by the recorded colours, on the tiles that the rows can change and that count."""
    tiles = output.tiles if wanted is None else wanted if output.tiles is None else wanted & output.tiles
    image = output.image.detach()
    recorded = target.exposure.apply(image) if target.exposure else image
    loss, upstream = target.loss.evaluate(recorded, target.prepared, target.dssim, tiles)
    # Else a pixel is NaN, or the image is so large that its square overflows. No loss is below 0.
    message = "image: expected finite values of ordinary size, got a loss that is not finite"
    require(loss < math.inf, lambda: ShapeError(message))
    if target.tile_weights is not None:
        upstream = upstream * spread_to_pixels(target.tile_weights, *image.shape[:2])[..., None]
    return loss, upstream


def _curvature(
    session: RenderSession,
    view: int,
    target: ViewTarget,
    transforms: GroupTransforms[torch.Tensor],
    leaves: Gaussians[torch.Tensor],
    image: torch.Tensor,
) -> torch.Tensor:
    """[K, 6, 6] of Gauss-Newton, from the share that each row has of a pixel's light. The image keeps its graph."""
    recorded = target.exposure.apply(image.detach()) if target.exposure else image.detach()
    tensor = weighted_structure_tensor(recorded, float_image(target.image))
    # The gradient of a pixel by a colour is the share that its Gaussian has of the pixel's light.
    (share,) = torch.autograd.grad(image, leaves.sh0, tensor, retain_graph=True)
    means, camera = leaves.means.detach(), session.pinhole(view)
    return curvature_of(means, transforms, session.cameras, camera=camera, structure=share[:, 0] / SH0)
