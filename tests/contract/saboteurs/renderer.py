"""Saboteurs of the checks of renderers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch

from gsstream.core.cameras import Cameras
from gsstream.core.context import ScreenGradient
from gsstream.engine.fit.exposure import Exposure
from gsstream.engine.fit.judge import Judge
from gsstream.render.base import Comparison, Pulled, RenderOutput, RenderSession, ScatterSession, WholePull
from gsstream.render.reference import ReferenceRenderer
from gsstream.testing.renderer.example import ExampleRenderer
from gsstream.testing.renderer.short_cuts import IMAGE
from saboteurs.register import spoils

# The reference is final; only a saboteur may inherit from it, and only behind the type checker's back.
Reference: Any = ReferenceRenderer
Adapter: Any = ExampleRenderer
Session: Any = ScatterSession


@spoils("check_renderer_range")
class Overshoot(Reference):
    """Sharpens: black falls a thousandth below 0."""

    def render(self, gaussians: Any, cameras: Cameras, view: int, background: Any) -> RenderOutput:
        drawn: RenderOutput = super().render(gaussians, cameras, view, background)
        return replace(drawn, image=torch.where(drawn.image < 1e-4, drawn.image - 1e-3, drawn.image))


@spoils("check_renderer_reference")
class Corners(Adapter):
    """Pixel centres at whole numbers: the picture is half a pixel off."""

    def render(self, gaussians: Any, cameras: Cameras, view: int, background: Any) -> RenderOutput:
        Ks = cameras.Ks.copy()
        Ks[:, :2, 2] += 0.5
        drawn: RenderOutput = super().render(gaussians, replace(cameras, Ks=Ks), view, background)
        return drawn


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
        pulled: ScreenGradient = super().screen_gradient(gaussians, cameras, view, image_gradient)
        return pulled._replace(gradient=pulled.gradient * cameras.width / 2)


class _SeesEverywhere(Session):
    def visible(self, view: int, tiles: torch.Tensor) -> torch.Tensor:
        found: torch.Tensor = super().visible(view, torch.ones_like(tiles))
        return found

    def commit(self, gaussians: Any, changed: torch.Tensor) -> RenderSession:
        return _SeesEverywhere(self._renderer, gaussians, None, self._cameras, self._background)


@spoils("check_renderer_visible")
class Unmasked(Reference):
    """Names everyone who is drawn anywhere in the image, whichever tiles are asked about."""

    def open(self, gaussians: Any, active: Any, cameras: Cameras, background: Any) -> RenderSession:
        session: RenderSession = _SeesEverywhere(self, gaussians, active, cameras, background)
        return session


class _StaleOpacities(Session):
    def render(self, view: int, rows: Any, **options: Any) -> RenderOutput:
        if self._active is not None:
            rows = replace(rows, opacities=self._gaussians.opacities[self._active] + 0 * rows.opacities)
        drawn: RenderOutput = super().render(view, rows, **options)
        return drawn

    def commit(self, gaussians: Any, changed: torch.Tensor) -> RenderSession:
        return _StaleOpacities(self._renderer, gaussians, None, self._cameras, self._background)


@spoils("check_renderer_session")
class Stale(Reference):
    """A narrowed session goes on with the opacities it was opened with."""

    def open(self, gaussians: Any, active: Any, cameras: Cameras, background: Any) -> RenderSession:
        session: RenderSession = _StaleOpacities(self, gaussians, active, cameras, background)
        return session


class _KeepsColours(Session):
    def commit(self, gaussians: Any, changed: torch.Tensor) -> RenderSession:
        kept = replace(gaussians, sh0=self._gaussians.sh0)
        session: RenderSession = _KeepsColours(self._renderer, kept, None, self._cameras, self._background)
        return session


@spoils("check_renderer_commit")
class Forgetful(Reference):
    """Takes positions over from frame to frame, and forgets the new colours."""

    def open(self, gaussians: Any, active: Any, cameras: Cameras, background: Any) -> RenderSession:
        session: RenderSession = _KeepsColours(self, gaussians, active, cameras, background)
        return session


class _HurriesOpacities(Session):
    def pull(self, view: int, rows: Any, comparison: Comparison) -> Pulled:
        leaves = rows.map(lambda value: value.detach().clone().requires_grad_())
        output = self.render(view, leaves)
        loss: Any = comparison.loss
        value, gradient = loss.evaluate(output.image.detach(), comparison.target, comparison.dssim)
        output.image.backward(gradient)
        gradients = leaves.map(lambda leaf: torch.zeros_like(leaf) if leaf.grad is None else leaf.grad)
        return Pulled(value, replace(gradients, opacities=1.1 * gradients.opacities))


@spoils("check_renderer_short_cuts")
class Hasty(Reference):
    """Has a short cut of its own, which lets opacities go a tenth further."""

    def open(self, gaussians: Any, active: Any, cameras: Cameras, background: Any) -> RenderSession:
        session: RenderSession = _HurriesOpacities(self, gaussians, active, cameras, background)
        return session


class _TurnsTwice(Session):
    def pull_whole(self, view: int, rows: Any, comparison: Comparison) -> WholePull:
        loss: Any = comparison.loss
        assert comparison.matrix is not None
        assert comparison.offset is not None
        exposure = Exposure(comparison.matrix.expand(2, 3, 3), comparison.offset.expand(2, 3))
        images = IMAGE.expand(view + 1, -1, -1, -1).numpy()
        plain: Any = Reference().open(rows, None, self._cameras, self._background)
        found = Judge(loss, comparison.dssim, images, exposure).pull_whole(plain, view, rows)
        return found._replace(gradients=replace(found.gradients, quats=2 * found.gradients.quats))


@spoils("check_renderer_whole")
class Turning(Reference):
    """Has a short cut for whole scenes, in which rotations count twice."""

    def open(self, gaussians: Any, active: Any, cameras: Cameras, background: Any) -> RenderSession:
        session: RenderSession = _TurnsTwice(self, gaussians, active, cameras, background)
        return session
