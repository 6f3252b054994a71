"""What the loss of a renderer and the change that a renderer finds promise: what the reference bodies find."""

from __future__ import annotations

from collections.abc import Iterator

import torch

from gsstream.core.cameras import Cameras
from gsstream.parts.backend.base import Renderer
from gsstream.parts.backend.change import Change, find_change
from gsstream.parts.render.loss import Loss, ReferenceLoss
from gsstream.testing.cases import BLACK, fingerprint, get_case
from gsstream.testing.compare import EXACT, at_most, equal, finite, relative
from gsstream.testing.registry import check

#: Pictures have three tiles by three, of which the border cuts the last.
HEIGHT, WIDTH = 40, 44
WHY = "sums of float32 in another order; relative to the largest"


def _pair() -> tuple[torch.Tensor, torch.Tensor]:
    """Image and target [H, W, 3] in [0, 1]; some pixels agree, some are flat."""
    g = torch.Generator().manual_seed(1)
    target = torch.rand(HEIGHT, WIDTH, 3, generator=g)
    target[:12, :12] = 0.5
    image = (target + 0.2 * torch.randn(target.shape, generator=g)).clamp(0, 1)
    image[20:, 30:] = target[20:, 30:]
    return image, target


def _evaluate(loss: Loss, dssim: float, mask: torch.Tensor | None = None) -> tuple[torch.Tensor, torch.Tensor]:
    image, target = _pair()
    return loss.evaluate(image, loss.prepare(target), dssim, mask)


def _agrees(loss: Loss, dssim: float, mask: torch.Tensor | None) -> None:
    (value, gradient), (want, wanted) = _evaluate(loss, dssim, mask), _evaluate(ReferenceLoss(), dssim, mask)
    off = abs(value - want)
    assert off <= 1e-5, f"dssim {dssim}: expected a loss of {want:.7f}, got {value:.7f} (tolerance 1e-5: float32)"
    relative(f"dssim {dssim}: gradient", gradient, wanted, tolerance=2e-3, why=WHY, floor=1e-5)


@check("renderer")
def check_loss_reference(part: Renderer) -> None:
    """Value and gradient are those of (1 - w) L1 + w (1 - SSIM) at w = 0, 0.2 and 1."""
    for dssim in (0.0, 0.2, 1.0):
        _agrees(part.loss, dssim, None)


@check("renderer")
def check_loss_mask(part: Renderer) -> None:
    """With a mask the sum runs over marked tiles and those beside; a full mask equals none, an empty one gives 0."""
    one = torch.zeros(3, 3, dtype=torch.bool)
    one[0, 0] = True
    _agrees(part.loss, 0.2, one)
    (value, gradient), (full, whole) = (
        _evaluate(part.loss, 0.2),
        _evaluate(part.loss, 0.2, torch.ones(3, 3, dtype=torch.bool)),
    )
    assert abs(value - full) <= 1e-6, f"a full mask: expected {value:.7f} as without, got {full:.7f}"
    equal("gradient with a full mask", whole, gradient, tolerance=1e-6, why=WHY)
    nothing, still = _evaluate(part.loss, 0.2, torch.zeros(3, 3, dtype=torch.bool))
    assert nothing == 0.0, f"an empty mask: expected a loss of exactly 0, got {nothing!r}"
    at_most("gradient with an empty mask", still.abs(), 0.0, tolerance=0.0, why="no tile is compared")


@check("renderer")
def check_loss_bytes(part: Renderer) -> None:
    """A target of bytes gives the bits that its float32 image gives."""
    image, target = _pair()
    codes = (target * 255).round().to(torch.uint8)
    (value, gradient), (want, wanted) = (
        part.loss.evaluate(image.clone(), part.loss.prepare(kind), 0.2)
        for kind in (codes, codes.float() / codes.new_tensor(255.0))
    )
    assert value == want, f"expected the loss of float32, {want!r}, got {value!r} for bytes"
    equal("gradient", gradient, wanted)


@check("renderer")
def check_loss_pure(part: Renderer) -> None:
    """Images come out as they went in, a prepared target serves again, and nothing hangs on a graph."""
    loss, (image, target) = part.loss, _pair()
    before = fingerprint((image, target))
    prepared = loss.prepare(target)
    leaf = image.clone().requires_grad_()
    first, gradient = loss.evaluate(leaf, prepared, 0.2)
    kept = gradient.clone()
    second, again = loss.evaluate(image, prepared, 0.2)
    assert fingerprint((image, target)) == before, "the image or the target was changed in place"
    assert leaf.grad is None and not gradient.requires_grad, "a gradient was left behind, or carries a graph"
    assert first == second, f"the second evaluation gives {second!r}, the first gave {first!r}"
    equal("second gradient", again, kept)
    equal("first gradient, after the second", gradient, kept)
    finite("gradient", gradient)


THRESHOLD = 6.0
SIZES = ((64, 80), (37, 49), (3, 5), (1, 1), (16, 16), (9, 130))
KINDS = ("still", "noise", "flash", "moved", "black to white")


def pictures(kind: str, height: int, width: int, stored: torch.dtype) -> tuple[torch.Tensor, torch.Tensor]:
    """Return an image before and after a change of this kind, both [H, W, 3] as they are stored."""
    g = torch.Generator().manual_seed(height * width)
    before = torch.rand(height, width, 3, generator=g)
    noisy = before + torch.randn(before.shape, generator=g) / 255
    now = {"noise": noisy, "flash": before * 1.2, "moved": noisy}.get(kind, before).clone()
    if kind == "moved":
        now[height // 3 : height // 2, width // 4 : width // 2] += 0.2
    if kind == "black to white":
        before, now = torch.zeros_like(before), torch.ones_like(now)
    if stored == torch.uint8:
        before, now = ((image.clamp(0, 1) * 255).round().to(torch.uint8) for image in (before, now))
    return before, now


def pairs(height: int, width: int) -> Iterator[tuple[str, tuple[torch.Tensor, torch.Tensor]]]:
    """Yield every kind of change of images of this size, stored as float32, as bytes, and as one of each."""
    for kind in KINDS:
        floats, codes = (pictures(kind, height, width, stored) for stored in (torch.float32, torch.uint8))
        yield f"{kind}, float32", floats
        yield f"{kind}, bytes", codes
        yield f"{kind}, one of each", (codes[0], floats[1])


@check("renderer")
def check_renderer_change(part: Renderer) -> None:
    """The tiles that changed, and the differences in them, are those of the default body, bit for bit."""
    for height, width in SIZES:
        for what, (before, now) in pairs(height, width):
            found, want = part.find_change([before], [now], THRESHOLD), find_change([before], [now], THRESHOLD)
            where = f"{what}, {width} x {height}"
            equal(f"{where}: tiles", found.tiles, want.tiles)
            equal(f"{where}: tiles and those beside them", found.dilated, want.dilated)
            equal(f"{where}: difference", found.difference(0, now, before), want.difference(0, now, before))
            values = torch.rand(height, width, 3)
            equal(f"{where}: values", found.only_changed(0, values), want.only_changed(0, values))


@check("renderer")
def check_renderer_changed_rows(part: Renderer) -> None:
    """Votes and rows are those of the default body, but for a centre on the border of a tile."""
    case = get_case("cloud")
    cameras = case.cameras.scaled(100, 75)
    scene = case.gaussians.rows(torch.arange(0, len(case.gaussians), 3))
    found, want = _changed(part, cameras)
    means = torch.cat([scene.means, 20 * torch.randn(300, 3, generator=torch.Generator().manual_seed(5))])
    votes, wanted = found.votes(means, cameras), want.votes(means, cameras)
    at_most("centres with other votes", (votes != wanted).sum(), 1, tolerance=0, why="a centre on the border of a tile")
    session = part.open(scene, None, cameras, BLACK)
    for moved in (scene.means, scene.means + 0.01):
        rows, asked = found.rows(moved, cameras, session, 0.5), session.visible_anywhere(want.tiles)
        expected = asked & (found.votes(moved, cameras) >= 0.5)
        equal("rows that changed", rows, expected)
    equal("tiles, after all that", found.tiles, want.tiles)
    none = part.find_change(*2 * ([torch.zeros(75, 100, 3)] * len(cameras),), THRESHOLD)
    rows = none.rows(scene.means, cameras, session, 0.0)
    at_most("rows where nothing changed", rows.sum(), 0, tolerance=0, why=EXACT)


def _changed(part: Renderer, cameras: Cameras) -> tuple[Change, Change]:
    """The same change found by the renderer and by the default body: a third of the picture, elsewhere in each view."""
    before = [torch.zeros(cameras.height, cameras.width, 3)] * len(cameras)
    now = [image.clone() for image in before]
    for view, image in enumerate(now):
        image[:, 30 * view : 30 * view + 30] = 0.5
    return part.find_change(before, now, THRESHOLD), find_change(before, now, THRESHOLD)
