"""The memory of still pixels: of every pixel of every training camera, the mean of its last values and their number.

A picture is noisy, the mean of n pictures of what stands still is less so by the square root of n. The memory depends
on the pictures alone, so a run that is resumed makes it again from them, from the last key packet on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gsstream.core.shapes import BoolArray, FloatArray, IntArray
from gsstream.engine.still.blocks import BLOCK, changed_blocks
from gsstream.metrics.noise import noise_sigma

#: Most pictures that a mean weighs: later ones replace older ones, so that a slow change of the light is followed.
MOST = 32
#: A block of pixels that differs from its mean by more than this many sigmas of block means begins anew, and so does
#: everything within REACH blocks of it: the smooth inside of a body may move without a difference that exceeds the
#: noise. Forgetting too much costs little; a target that lags behind what moves costs half a decibel there (measured).
THRESHOLD, REACH = 4.0, 6
#: Pictures behind a mean before it is a target.
LEAST_COUNT = 4
#: Steps of a stored mean between 0 and 1: its rounding error is a hundredth of a grey level at 8 bits.
STEPS = 65535
#: Bounds on the noise of one pixel, image units: half a grey level, and what only a moving picture has.
LEAST_NOISE, MOST_NOISE = 0.5 / 255, 16 / 255


@dataclass(frozen=True, slots=True)
class StillMemory:
    """Seven bytes per pixel and training camera.

    Arguments:
        mean: [V, H, W, 3] uint16, in steps of 1/65535.
        count: [V, H, W] uint8, how many pictures it is the mean of, 1 to 32.
        sigma: [V] float64 noise of one pixel of one picture, image units; empty until there are two pictures.
    """

    mean: IntArray
    count: IntArray
    sigma: FloatArray

    @staticmethod
    def start(images: FloatArray) -> StillMemory:
        """Return the memory of one picture of each camera, [V, H, W, 3] in [0, 1]."""
        return StillMemory(_stored(images), np.ones(images.shape[:3], np.uint8), np.zeros(0))

    def after(self, images: FloatArray) -> StillMemory:
        """Return the memory after the next picture [V, H, W, 3] of each camera."""
        mean, count = np.empty_like(self.mean), np.empty_like(self.count)
        sigma = list(self.sigma)
        for view, image in enumerate(images):
            known = self.values(view)
            if not len(self.sigma):
                sigma.append(min(max(noise_sigma(known, image), LEAST_NOISE), MOST_NOISE))
            difference = image - known
            anew = _pixels(_grown(changed_blocks(difference, THRESHOLD)), image.shape[:2])
            number = np.where(anew, 1, np.minimum(self.count[view].astype(np.int64) + 1, MOST))
            mean[view] = _stored(known + difference / number[..., None].astype(np.float32))
            count[view] = number
        return StillMemory(mean, count, np.array(sigma))

    def values(self, view: int) -> FloatArray:
        """Return [H, W, 3] float32: the means of a camera."""
        return np.asarray(np.divide(self.mean[view], np.float32(STEPS), dtype=np.float32))

    def targets(self, images: FloatArray) -> FloatArray:
        """Return [V, H, W, 3]: the pictures, in which what has stood still for four of them has its mean instead.

        Arguments:
            images: the pictures that :meth:`after` was given last.
        """
        out = images.copy()
        for view, count in enumerate(self.count):
            still = count >= LEAST_COUNT
            out[view][still] = self.values(view)[still]
        return out


def _stored(images: FloatArray) -> IntArray:
    # A picture may exceed [0, 1] by the rounding of resampling (core.frame.ROUNDING), which unsigned steps cannot hold.
    return np.asarray(np.rint(np.clip(images, 0, 1) * np.float32(STEPS)).astype(np.uint16))


def _grown(blocks: BoolArray) -> BoolArray:
    """The marked blocks and all within REACH of one, along rows and columns, where at least two lie close together.

    One alone is noise: there are thousands of blocks, and noise has heavy tails. It is marked, and nothing beside it.
    """
    near = _near(blocks, 1)
    bodies = blocks & (near > 1)
    return np.asarray(blocks | (_near(bodies, REACH) > 0))


def _near(blocks: BoolArray, reach: int) -> IntArray:
    """How many blocks are marked in the square of blocks around each."""
    total = np.pad(blocks, ((reach + 1, reach), (reach + 1, reach))).cumsum(0, dtype=np.int64).cumsum(1)
    side = 2 * reach + 1
    inside = total[side:, side:] - total[:-side, side:] - total[side:, :-side] + total[:-side, :-side]
    return np.asarray(inside)


def _pixels(blocks: BoolArray, size: tuple[int, ...]) -> BoolArray:
    """[H, W] bool from blocks of pixels."""
    return blocks.repeat(BLOCK, 0).repeat(BLOCK, 1)[: size[0], : size[1]]
