"""Checks of ``loss_and_grad``: equal the default body; gradients repeat, add up over tiles, are 0 for unseen rows."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from gsstream.core.changes.motion import GroupTransforms
from gsstream.core.errors import ComponentError, ShapeError
from gsstream.core.gaussians import ATTRIBUTES, Gaussians
from gsstream.parts.backend.base import Renderer
from gsstream.parts.render.exposure import CameraExposure
from gsstream.parts.render.images import TILE
from gsstream.parts.render.loss import Loss
from gsstream.parts.render.session import RenderSession
from gsstream.parts.render.target import ViewTarget
from gsstream.parts.render.wrt import LossAndGrad, Wrt, WrtRows, WrtScene, WrtTransforms
from gsstream.testing.cases import SIZE, Scene, fingerprint, get_case
from gsstream.testing.compare import EXACT, at_most, equal, gradients_equal, relative
from gsstream.testing.registry import check

#: Tolerance as a share of the largest value of a gradient. A renderer may blend what stands still once for all passes
#: of a frame, and then
#: compositing may stop one Gaussian later in a pixel near the transmittance cut-off (docs/results/cost.md).
NEAR = 5e-3
WHY = "the same calls, up to rounding and the end of a pixel's light"
#: Least value that errors of gradients and curvatures of transforms are divided by: a thousandth of their size in this
#: scene.
MIN_GRADIENT = 1e-5
#: What renders are compared with.
IMAGE = torch.rand(SIZE, SIZE, 3, generator=torch.Generator().manual_seed(4))
GREY = (0.2, 0.5, 0.9)
TILES = -(-SIZE // TILE)


def targets(loss: Loss) -> Iterator[tuple[str, ViewTarget]]:
    """Yield what a view may be compared with: with and without a colour map, with all tiles, some, and weights.

    SSIM alone, because a pixel that L1 sees from its other side has a gradient of the other sign.
    """
    g = torch.Generator().manual_seed(6)
    exposure = CameraExposure(torch.eye(3) + 0.1 * torch.randn(3, 3, generator=g), 0.1 * torch.randn(3, generator=g))
    some = (torch.arange(TILES * TILES).reshape(TILES, TILES) % 3 > 0).float()
    plain = ViewTarget(loss, loss.prepare(IMAGE), 1.0, IMAGE)
    for colours, seen in (("", plain), (", colour map", replace(plain, exposure=exposure))):
        for tiles, weights in (("", None), (", some tiles", some), (", weights of tiles", some * (1 + 3 * some.T))):
            yield colours + tiles, replace(seen, tile_weights=weights)


def cases(part: Renderer) -> Iterator[tuple[str, int, ViewTarget]]:
    """Yield every kind of target of the renderer's loss, for two cameras in turns."""
    for place, (kind, target) in enumerate(targets(part.loss)):
        view = (place + place // 3) % 2
        yield f"camera {view}{kind}", view, target


def narrowed(part: Renderer) -> tuple[RenderSession, Scene]:
    """Return a narrowed session, and other values of its rows."""
    case = get_case("cloud")
    active = torch.arange(0, len(case.gaussians), 9)
    session = part.open(case.gaussians, None, case.cameras, GREY)
    session.narrow(active)
    g = torch.Generator().manual_seed(3)
    return session, case.gaussians.rows(active).map(lambda v: v + 0.02 * torch.randn(v.shape, generator=g))


def transforms(count: int) -> GroupTransforms[torch.Tensor]:
    """Return small transforms of three groups of so many rows."""
    rng = np.random.default_rng(5)
    parts = (0.02 * rng.standard_normal((3, 3)) for _ in range(3))
    return GroupTransforms(np.arange(count), np.arange(count) % 3, *parts).map(torch.from_numpy)


def compare(what: str, got: LossAndGrad[Any], want: LossAndGrad[Any], tolerance: float) -> None:
    """Fail unless two results have the same tensors, up to ``tolerance`` of the largest value of each."""
    equal(f"{what}: loss", got.loss, want.loss, tolerance=1e-4, why=WHY)
    if isinstance(want.grad, Gaussians):
        ours, theirs = (_given({**dict(found.grad.items()), "2-D means": found.means2d}) for found in (got, want))
        gradients_equal(what, ours, theirs, tolerance=tolerance, why=WHY)
    else:
        relative(f"{what}: gradient", got.grad, want.grad, tolerance=tolerance, why=WHY, floor=MIN_GRADIENT)
    for name in ("curvature", "exposure"):
        one, other = getattr(got, name), getattr(want, name)
        assert (one is None) == (other is None), f"{what}: {name}: expected {other!r}, got {one!r}"
        if one is not None:
            relative(f"{what}: {name}", one, other, tolerance=tolerance, why=WHY, floor=MIN_GRADIENT)


def _given(gradients: dict[str, torch.Tensor | None]) -> dict[str, torch.Tensor]:
    return {name: value for name, value in gradients.items() if value is not None}


@check("renderer")
def check_renderer_loss_and_grad(part: Renderer) -> None:
    """A narrowed session's own ``loss_and_grad`` gives what the default body gives, by rows and by transforms."""
    if type(narrowed(part)[0]).loss_and_grad is RenderSession.loss_and_grad:
        return
    for what, view, target in cases(part):
        session, rows = narrowed(part)
        some: tuple[Wrt[Any], ...] = WrtRows(rows), WrtTransforms(rows, transforms(len(rows)), curvature=True)
        for wrt in some:
            found = session.loss_and_grad(view, target, wrt)
            want = RenderSession.loss_and_grad(narrowed(part)[0], view, target, wrt)
            compare(f"{type(wrt).__name__}, {what}", found, want, NEAR)


@check("renderer")
def check_renderer_loss_and_grad_scene(part: Renderer) -> None:
    """A wide session's own ``loss_and_grad`` gives what the default body gives by a whole scene."""
    case = get_case("cloud")
    session = part.open(case.gaussians, None, case.cameras, GREY)
    if type(session).loss_and_grad is RenderSession.loss_and_grad:
        return
    for what, view, target in cases(part):
        wrt = WrtScene(case.gaussians)
        try:
            want = RenderSession.loss_and_grad(session, view, target, wrt)
        except NotImplementedError:  # its render offers no gradient of the 2-D means
            wrt = replace(wrt, means2d=False)
            want = RenderSession.loss_and_grad(session, view, target, wrt)
        compare(f"WrtScene, {what}", session.loss_and_grad(view, target, wrt), want, 1e-5)


@check("renderer")
def check_renderer_loss_and_grad_kept(part: Renderer) -> None:
    """Rows of a scene that are not kept are not drawn: the others have the gradient of a scene without them."""
    case = get_case("cloud")
    keep = torch.rand(len(case.gaussians), generator=torch.Generator().manual_seed(8)) < 0.7
    less = case.gaussians.rows(keep)
    session, without = (part.open(rows, None, case.cameras, GREY) for rows in (case.gaussians, less))
    what, target = "WrtScene, some rows kept", ViewTarget(part.loss, part.loss.prepare(IMAGE), 0.2, IMAGE)
    found = session.loss_and_grad(0, target, WrtScene(case.gaussians, means2d=False, keep=keep))
    want = without.loss_and_grad(0, target, WrtScene(less, means2d=False))
    compare(what, replace(found, grad=found.grad.rows(keep), exposure=want.exposure), want, 1e-5)
    for attribute, value in found.grad.rows(~keep).items():
        at_most(f"{what}: gradient of {attribute} of the others", value.abs(), 0.0, tolerance=0.0, why=EXACT)


@check("renderer")
def check_renderer_grad(part: Renderer) -> None:
    """Gradients repeat bit for bit, leave rows and graphs alone, add up over tiles, and are 0 where nothing counts."""
    loss = part.loss
    target = ViewTarget(loss, loss.prepare(IMAGE), 0.0, IMAGE)  # without SSIM: a sum over pixels
    session, rows = narrowed(part)
    leaves = rows.map(lambda value: value.clone().requires_grad_())
    before = fingerprint(leaves.map(torch.Tensor.detach))
    first, again = (session.loss_and_grad(0, target, WrtRows(leaves)).grad for _ in range(2))
    assert fingerprint(leaves.map(torch.Tensor.detach)) == before, "loss_and_grad: the rows were changed in place"
    left = torch.arange(TILES * TILES).reshape(TILES, TILES) % 2 == 0
    one, other, none = (
        session.loss_and_grad(0, replace(target, tile_weights=weights.float()), WrtRows(rows))
        for weights in (left, ~left, left & ~left)
    )
    at_most("loss where no tile counts", none.loss.abs(), 0.0, tolerance=0.0, why=EXACT)
    for name, value in first.items():
        assert getattr(leaves, name).grad is None, f"loss_and_grad: a gradient was left on the caller's {name}"
        equal(f"second gradient of {name}", getattr(again, name), value)
        if value.numel():
            both = getattr(one.grad, name) + getattr(other.grad, name)
            halves = f"gradient of {name}, two halves of the tiles"
            relative(halves, both, value, tolerance=NEAR, why="sums in another order", floor=MIN_GRADIENT)
            at_most(
                f"gradient of {name} where no tile counts",
                getattr(none.grad, name).abs(),
                0.0,
                tolerance=0.0,
                why=EXACT,
            )


@check("renderer")
def check_renderer_grad_unseen(part: Renderer) -> None:
    """Rows that are not in view have a gradient of exactly 0, alone and as a whole scene."""
    case = get_case("unseen")
    loss = part.loss
    target = ViewTarget(loss, loss.prepare(IMAGE), 0.2, IMAGE)
    hidden = (case.gaussians.means[:, 1] > 10).nonzero()[:, 0]
    session = part.open(case.gaussians, None, case.cameras, GREY)
    whole = session.loss_and_grad(0, target, WrtScene(case.gaussians, means2d=False)).grad.rows(hidden)
    session.narrow(hidden)
    alone = session.loss_and_grad(0, target, WrtRows(case.gaussians.rows(hidden))).grad
    for how, found in (("as a whole scene", whole), ("alone", alone)):
        for name, value in found.items():
            at_most(f"gradient of {name} of what is not in view, {how}", value.abs(), 0.0, tolerance=0.0, why=EXACT)


@check("renderer")
def check_renderer_grad_refuses(part: Renderer) -> None:
    """A value that is not finite is refused, in whatever attribute it is."""
    loss = part.loss
    target = ViewTarget(loss, loss.prepare(IMAGE), 0.2, IMAGE)
    for name in ATTRIBUTES:
        session, rows = narrowed(part)
        if getattr(rows, name).numel() == 0:
            continue
        wrong = replace(rows, **{name: torch.full_like(getattr(rows, name), torch.nan)})
        try:
            session.loss_and_grad(0, target, WrtRows(wrong))
        except (ShapeError, ComponentError):
            continue
        raise AssertionError(f"{name}: values that are not finite were accepted")
