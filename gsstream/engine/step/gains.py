"""A camera that gets brighter or darker alone: the others say so, its pictures are fitted so, the scene stays as it is.

A camera's exposure and its white balance may drift, as automatic ones do. What moves is fitted to all cameras alike, so
that one of them drags it along. A gain for each camera and channel goes on from frame to frame: it is found in closed
form where :func:`~gsstream.engine.state.drift.cameras_apart` saw a camera leave the others, and for all cameras
wherever the colours follow the light. It multiplies what the scene looks like to this camera, is reported, and is never
drawn.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch

from gsstream.core.cameras import Cameras
from gsstream.core.gaussians import SH0, Gaussians
from gsstream.core.shapes import FloatArray
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.state.drift import GRIDS, STILL, STRIDE, Lit, changes, ratio_in_most

#: Digits to which a gain is known, so that no rounding decides what a resumed run goes on from.
DIGITS = 4
#: Levels of 255 from which a camera has drifted, and not only its noise.
TOLD = 0.1
#: Least and largest gain: beyond them a camera is broken, and nothing is made of its noise.
LEAST, MOST = 1 / 8, 8.0


def new_gains(
    assembly: Assembly,
    scene: Gaussians[torch.Tensor],
    cameras: Cameras,
    *,
    before: Lit,
    now: Lit,
    apart: Sequence[int],
) -> FloatArray | None:
    """Return the gains [V, 3] of all cameras, of which those that drift alone have new ones.

    Two sets of pictures are compared, and the scene says which of their pixels show the same Gaussian. What several
    cameras see alike is the light's, however few of them see it: a share by which each Gaussian became brighter and one
    for each camera explain all pixels, in the least squares.

    Arguments:
        scene: what players had before the frame.
        before, now: pixels of an earlier frame and of this one, each with the gains of its time.
        apart: cameras that may get another gain.
    """
    if len(cameras) < 3:  # of two neither is most
        return now.gains
    pixels = changes(before, now)
    first, changed = pixels
    # What moved is left out, and a camera whose exposure jumped is not taken for one before which everything moved.
    own = ratio_in_most(pixels)[:, None, None] * first
    still = ((changed - own).abs().amax(-1, keepdim=True) <= STILL).float()
    counted = still * _within(before) * _within(now)
    kept = changed * counted, first * counted
    asked = torch.stack([_by_row(assembly, scene, cameras, view=v, pixels=kept) for v in range(len(cameras))])
    errors, lights = asked[:, 0], asked[:, 1].clamp_min(0)
    # A share of the brightness is an offset in a scene whose light is the brightness.
    channels = [camera_offsets(errors[..., c].sum(1), errors[..., c].sum(0), lights[..., c]) for c in range(3)]
    found = torch.stack(channels, 1)
    levels = (found * first.mean((0, 2, 3)).cpu()).abs().amax(1)
    gains = np.ones((len(cameras), 3), np.float32) if now.gains is None else now.gains.copy()
    after = (gains * (1 + found.numpy())).round(DIGITS)
    enough, sound = levels.numpy() > TOLD, ((after >= LEAST) & (after <= MOST)).all(1)
    told = [view for view in apart if enough[view] and sound[view]]
    if not told:
        return now.gains
    gains[told] = after[told]
    return gains


def _within(lit: Lit) -> torch.Tensor:
    """Return where a channel of a pixel is neither at its end: one that is says less than what came to the camera."""
    top = 1.0 if lit.pixels.is_floating_point() else 255
    return ((lit.pixels > 0) & (lit.pixels < top)).float()


def _by_row(
    assembly: Assembly,
    scene: Gaussians[torch.Tensor],
    cameras: Cameras,
    *,
    view: int,
    pixels: tuple[torch.Tensor, torch.Tensor],
) -> torch.Tensor:
    """Return [2, N, 3]: two sets [2, V, h, w, 3] of pixels, summed by the share that a Gaussian has of their light."""
    drawn, by_row = drawn_by_row(assembly, scene, cameras, view)
    found = []
    for values in pixels:
        image = torch.zeros_like(drawn)
        height, width = (size // STRIDE * STRIDE for size in image.shape[:2])
        for start, grid in zip(GRIDS, values[:, view], strict=True):
            image[start:height:STRIDE, start:width:STRIDE] = grid
        found.append(by_row(image))
    return torch.stack(found)


def drawn_by_row(
    assembly: Assembly, scene: Gaussians[torch.Tensor], cameras: Cameras, view: int
) -> tuple[torch.Tensor, Callable[[torch.Tensor], torch.Tensor]]:
    """Return what a camera sees of a scene, [H, W, 3], and what sums an image [H, W, 3] over pixels to [N, 3].

    Each pixel counts by the share that a Gaussian has of its light, which is the gradient of the pixel by its colour.
    """
    colour = scene.sh0.clone().requires_grad_()
    drawn = assembly.renderer.render(replace(scene, sh0=colour), cameras, view, assembly.background).image

    def by_row(image: torch.Tensor) -> torch.Tensor:
        return torch.autograd.grad(drawn, colour, image.contiguous(), retain_graph=True)[0][:, 0].cpu() / SH0

    return drawn.detach(), by_row


def camera_offsets(asked_by_view: torch.Tensor, asked: torch.Tensor, light: torch.Tensor) -> torch.Tensor:
    """Return [V] or [V, C]: what each camera asks of all colours it sees, beyond what the others ask of the same.

    The least squares of a colour a row and an offset a camera together, with the rows eliminated. All offsets may be
    larger by the same and all colours smaller: of all solutions the one whose offsets have the median 0, because what
    most cameras ask for is the light's, and what a few ask for beyond it is their own, however much it is.

    Arguments:
        asked_by_view, asked: [V, C], [N, C] or [V], [N] errors, summed over rows and over views, of which each is a sum
            over pixels by the light that the row gives them.
        light: [V, N] that light.
    """
    light = light.double()
    shares = light / light.sum(0).clamp_min(1e-6)
    matrix = light.sum(1).diag() - shares @ light.T
    right = asked_by_view.double() - shares @ asked.double()
    inverse: torch.Tensor = torch.linalg.pinv(matrix, rtol=1e-6, hermitian=True)
    offsets = inverse @ right
    seen = offsets[light.sum(1) > 0]
    return (offsets - seen.quantile(0.5, 0)).float() if len(seen) else offsets.float()
