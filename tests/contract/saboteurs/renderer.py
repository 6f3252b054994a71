"""Saboteurs of the checks of renderers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch

from gsstream.core.cameras import Cameras
from gsstream.core.context import ScreenGradient
from gsstream.parts.backend.base import ScatterSession
from gsstream.parts.backend.change import Change, find_change
from gsstream.parts.backend.reference import ReferenceRenderer
from gsstream.parts.render.session import RenderOutput, RenderSession
from gsstream.parts.render.target import ViewTarget
from gsstream.parts.render.wrt import LossAndGrad, WrtRows, WrtScene, WrtTransforms
from gsstream.testing.examples.renderer import ExampleRenderer
from saboteurs.register import spoils

# The reference is final; only a saboteur may inherit from it, and only behind the type checker's back.
Reference: Any = ReferenceRenderer
Adapter: Any = ExampleRenderer
Session: Any = ScatterSession


class Opens(Reference):
    """The reference, with sessions of the class ``opened``."""

    opened: Any

    def open(self, gaussians: Any, active: Any, cameras: Cameras, background: Any) -> RenderSession:
        session: RenderSession = self.opened(self, gaussians, active, cameras, background)
        return session


@spoils("check_renderer_range")
class Overshoot(Reference):
    """Sharpens: black falls a thousandth below 0."""

    def render(self, gaussians: Any, cameras: Cameras, view: int, background: Any) -> RenderOutput:
        drawn: RenderOutput = super().render(gaussians, cameras, view, background)
        return replace(drawn, image=torch.where(drawn.image < 1e-4, drawn.image - 1e-3, drawn.image))


@spoils("check_renderer_reference")
class Strong(Adapter):
    """Everything stands out from the background by a hundredth too much; gradients are right."""

    def render(self, gaussians: Any, cameras: Cameras, view: int, background: Any) -> RenderOutput:
        drawn: RenderOutput = super().render(gaussians, cameras, view, background)
        return replace(drawn, image=drawn.image + 0.01 * (drawn.image.detach() - torch.tensor(background)))


@spoils("check_renderer_gradient")
class HalfTurned(Adapter):
    """Draws rightly, and gives half the gradient by the rotation."""

    def render(self, gaussians: Any, cameras: Cameras, view: int, background: Any) -> RenderOutput:
        halved = (gaussians.quats + gaussians.quats.detach()) / 2
        drawn: RenderOutput = super().render(replace(gaussians, quats=halved), cameras, view, background)
        return drawn


@spoils("check_renderer_repeatable")
class Meddler(Reference):
    """Clamps the opacities it is given, in place."""

    def render(self, gaussians: Any, cameras: Cameras, view: int, background: Any) -> RenderOutput:
        gaussians.opacities.detach().clamp_(max=7.0)
        drawn: RenderOutput = super().render(gaussians, cameras, view, background)
        return drawn


@spoils("check_renderer_screen_gradient")
class Normalised(Reference):
    """Gradients by coordinates from -1 to 1 instead of pixels, as the released 3DGS has them."""

    def screen_gradient(self, gaussians: Any, cameras: Cameras, view: int, image_gradient: Any) -> ScreenGradient:
        found: ScreenGradient = super().screen_gradient(gaussians, cameras, view, image_gradient)
        return found._replace(gradient=found.gradient * cameras.width / 2)


class _SeesEverywhere(Session):
    def visible(self, view: int, tiles: torch.Tensor) -> torch.Tensor:
        found: torch.Tensor = super().visible(view, torch.ones_like(tiles))
        return found

    def commit(self, gaussians: Any, changed: torch.Tensor) -> RenderSession:
        return _SeesEverywhere(self._renderer, gaussians, None, self._cameras, self._background)


@spoils("check_renderer_contributing")
class Unmasked(Opens):
    """Names everyone who is drawn anywhere in the image, whichever tiles are asked about."""

    opened = _SeesEverywhere


class _StaleOpacities(Session):
    def render(self, view: int, rows: Any, **options: Any) -> RenderOutput:
        if self._active is not None:
            rows = replace(rows, opacities=self._gaussians.opacities[self._active] + 0 * rows.opacities)
        drawn: RenderOutput = super().render(view, rows, **options)
        return drawn

    def commit(self, gaussians: Any, changed: torch.Tensor) -> RenderSession:
        return _StaleOpacities(self._renderer, gaussians, None, self._cameras, self._background)


@spoils("check_renderer_session")
class Stale(Opens):
    """A narrowed session goes on with the opacities it was opened with."""

    opened = _StaleOpacities


class _KeepsColours(Session):
    def commit(self, gaussians: Any, changed: torch.Tensor) -> RenderSession:
        kept = replace(gaussians, sh0=self._gaussians.sh0)
        session: RenderSession = _KeepsColours(self._renderer, kept, None, self._cameras, self._background)
        return session


@spoils("check_renderer_commit")
class Forgetful(Opens):
    """Takes positions over from frame to frame, and forgets the new colours."""

    opened = _KeepsColours


class _HurriesOpacities(Session):
    def loss_and_grad(self, view: int, target: ViewTarget, wrt: Any) -> LossAndGrad[Any]:
        found = super().loss_and_grad(view, target, wrt)
        if not isinstance(wrt, WrtRows):
            return found  # type: ignore[no-any-return]
        return replace(found, grad=replace(found.grad, opacities=1.1 * found.grad.opacities))


@spoils("check_renderer_loss_and_grad")
class Hasty(Opens):
    """Differentiates by a body of its own, which lets opacities go a tenth further."""

    opened = _HurriesOpacities


class _TurnsTwice(Session):
    def render(self, view: int, rows: Any, *, probe: Any = None, tile_mask: Any = None) -> RenderOutput:
        drawn: RenderOutput = self._renderer._render(self._whole(rows), self._cameras, view, self._background, probe)
        return drawn

    def loss_and_grad(self, view: int, target: ViewTarget, wrt: Any) -> LossAndGrad[Any]:
        found: LossAndGrad[Any] = super().loss_and_grad(view, target, wrt)
        if not isinstance(wrt, WrtScene):
            return found
        return replace(found, grad=replace(found.grad, quats=2 * found.grad.quats))


@spoils("check_renderer_loss_and_grad_scene")
class Turning(Opens):
    """Differentiates a whole scene by a body of its own, in which rotations count twice."""

    opened = _TurnsTwice


class _DrawsAll(Session):
    def loss_and_grad(self, view: int, target: ViewTarget, wrt: Any) -> LossAndGrad[Any]:
        whole = replace(wrt, keep=None) if isinstance(wrt, WrtScene) else wrt
        found: LossAndGrad[Any] = super().loss_and_grad(view, target, whole)
        return found


@spoils("check_renderer_loss_and_grad_kept")
class Thorough(Opens):
    """Draws the rows of a scene that are to be left out, too."""

    opened = _DrawsAll


class _LeavesTraces(Session):
    def loss_and_grad(self, view: int, target: ViewTarget, wrt: Any) -> LossAndGrad[Any]:
        found: LossAndGrad[Any] = super().loss_and_grad(view, target, wrt)
        if isinstance(wrt, WrtRows):
            wrt.values.means.grad = torch.zeros_like(wrt.values.means)
        return found


@spoils("check_renderer_grad")
class Untidy(Opens):
    """Leaves a gradient on the rows that it was given."""

    opened = _LeavesTraces


class _Decays(Session):
    def loss_and_grad(self, view: int, target: ViewTarget, wrt: Any) -> LossAndGrad[Any]:
        found: LossAndGrad[Any] = super().loss_and_grad(view, target, wrt)
        partly = isinstance(wrt, WrtScene) and wrt.keep is not None
        if target.tile_weights is not None or partly or isinstance(wrt, WrtTransforms):
            return found
        return replace(found, grad=found.grad.map(lambda value: value + 1e-30))


@spoils("check_renderer_grad_unseen")
class Decaying(Opens):
    """Adds a trace of decay to every gradient: only those of rows out of view, which are 0, differ by it."""

    opened = _Decays


class _Repairs(Session):
    def render(self, view: int, rows: Any, **options: Any) -> RenderOutput:
        drawn: RenderOutput = super().render(view, rows.map(torch.nan_to_num), **options)
        return drawn


@spoils("check_renderer_grad_refuses")
class Repairing(Opens):
    """Takes 0 for a value that is not a number, and says nothing."""

    opened = _Repairs


@spoils("check_renderer_change")
class Lenient(Adapter):
    """Finds a change only where it is a tenth larger than the threshold says."""

    def find_change(self, before: Any, now: Any, threshold: float) -> Change:
        return find_change(before, now, 1.1 * threshold)


class _Late(Change):
    def rows(self, means: torch.Tensor, cameras: Cameras, session: RenderSession, min_votes: float) -> torch.Tensor:
        return super().rows(means, cameras, session, min_votes) & (means[:, 0] > 0)


@spoils("check_renderer_changed_rows")
class Onesided(Adapter):
    """Takes only rows on one side of the scene for changed."""

    def find_change(self, before: Any, now: Any, threshold: float) -> Change:
        found = find_change(before, now, threshold)
        return _Late(found.tiles, found.height, found.width)
