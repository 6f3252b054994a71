"""What the loss of a renderer promises: the value and the gradient of the reference."""

from __future__ import annotations

import torch

from gsstream.parts.backend.base import Renderer
from gsstream.parts.render.loss import Loss, ReferenceLoss
from gsstream.testing.cases import fingerprint
from gsstream.testing.compare import at_most, equal, finite, relative
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
    """With a mask of tiles the sum runs over them and those beside; a full mask equals no mask; none is 0."""
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
    """A target of bytes is the image that it stands for, bit for bit."""
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
