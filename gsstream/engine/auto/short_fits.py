"""A trial: frame 0 as a run makes it, packet and all, with fewer passes and without the cameras that judge it.

It is made once for every fold, each without other cameras: three cameras have liked one of two scenes as much as the
other, and three others told them apart by 0.4 dB (docs/results/auto.md).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from statistics import fmean

import numpy as np
import torch

from gsstream.core.frame import Frame, PointCloud
from gsstream.core.gaussians import Gaussians
from gsstream.core.rng import Rng
from gsstream.core.shapes import FloatArray
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.frame0.begin import begin, seeded
from gsstream.metrics import psnr
from gsstream.packet import StreamMeta

#: Gain in dB that a key packet of half the size counts as. It is small, because short fits show only a part of what
#: more coefficients gain in long ones: it decides between choices of the same quality.
HALVED = 0.1
#: A trial that is this far behind after a fold, dB, is not made on the other folds.
HOPELESS = 0.25
#: With fewer training cameras than this, none can be left out.
LEAST_CAMERAS = 4


@dataclass(frozen=True, slots=True)
class Trial:
    """The result of one choice in short fits of frame 0.

    Arguments:
        folds: PSNR of the cameras that each fold left out, after the best affine colour map (they have none of their
            own yet). All trials have their folds in the same order; one that was given up has fewer.
        gaussians, size: Gaussians, and bytes of the key packet, of the first fold.
    """

    folds: tuple[float, ...]
    gaussians: int
    size: int

    @property
    def psnr(self) -> float:
        """Mean of the folds, dB."""
        return fmean(self.folds)

    @property
    def score(self) -> float:
        """PSNR less the price of the bytes, dB: what trials are compared by."""
        return self.psnr - HALVED * math.log2(self.size)

    def gain(self, other: Trial) -> float:
        """Return what this scores more than another in the folds that both have, dB; negative: less."""
        shared = min(len(self.folds), len(other.folds))
        mine, theirs = (replace(trial, folds=trial.folds[:shared]) for trial in (self, other))
        return mine.score - theirs.score

    def beats(self, other: Trial, margin: float = 0.0) -> bool:
        """Say whether it gains more than ``margin``; one that was given up beats nothing with more folds."""
        return len(self.folds) >= len(other.folds) and self.gain(other) > margin


def left_out(count: int, share: float, folds: int) -> list[list[int]]:
    """Return which training cameras the trials do without, fold by fold.

    Each fold leaves out about that share, at least one, evenly spread; no camera is in two of them. There are as many
    folds as are asked for, or as there are cameras for; none when there are too few cameras to spare one.

    Arguments:
        count: number of training cameras.
        share: share of them that a fold leaves out, 0 to 1.
        folds: number of folds asked for.
    """
    if count < LEAST_CAMERAS:
        return []
    number = min(max(1, round(share * count)), count // 2)
    folds = min(folds, count // number)
    # Camera (i + phase) * count / number, in whole numbers; phases 1/2, then further ones at equal distances.
    phases = [(folds + 2 * fold) % (2 * folds) for fold in range(folds)]
    return [[(2 * folds * i + phase) * count // (2 * folds * number) for i in range(number)] for phase in phases]


class FirstFrameTrials:
    """Makes trials of one scene; the same anchors and degree are one trial, whatever settings placed them."""

    def __init__(self, points: PointCloud, frame: Frame, meta: StreamMeta, seed: int, folds: list[list[int]]) -> None:
        self._points, self._meta, self._seed = points, meta, seed
        everyone = range(len(frame.cameras))
        self._fitted = [_views(frame, [i for i in everyone if i not in judges]) for judges in folds]
        self._judges = [_views(frame, judges) for judges in folds]
        self._known: dict[tuple[int, bytes], Trial] = {}

    def __call__(self, parts: Assembly, best: Trial | None) -> Trial:
        """The trial of these settings; made anew only when nothing with the same start was.

        Arguments:
            best: the trial that it has to beat; once that is out of reach, further folds are not made.
        """
        anchors = [seeded(parts, self._points, fitted).positions.numpy().tobytes() for fitted in self._fitted]
        key = (parts.recipe.first_frame.degree, b"".join(anchors))
        if key not in self._known:
            self._known[key] = self._tried(parts, best)
        return self._known[key]

    def _tried(self, parts: Assembly, best: Trial | None) -> Trial:
        trial = self._fit(parts, 0)
        for fold in range(1, len(self._fitted)):
            if best is not None and trial.gain(best) < -HOPELESS:
                break
            trial = replace(trial, folds=trial.folds + self._fit(parts, fold).folds)
        return trial

    def _fit(self, parts: Assembly, fold: int) -> Trial:
        settings = parts.recipe.first_frame
        brief = settings.model_copy(update={"epochs": min(settings.epochs, settings.trial_epochs)})
        parts = replace(parts, recipe=parts.recipe.model_copy(update={"first_frame": brief}))
        step = begin(parts, self._points, self._fitted[fold], self._meta, Rng(self._seed), lambda *_: None)
        decoded = step.state.player.gaussians
        found = _judged(parts, decoded.map(torch.from_numpy), self._judges[fold])
        return Trial((found,), len(decoded), len(step.packet.data))


def _judged(parts: Assembly, gaussians: Gaussians[torch.Tensor], judges: Frame) -> float:
    found = []
    for view, target in enumerate(judges.images):
        with torch.no_grad():
            image = parts.renderer.render(gaussians, judges.cameras, view, parts.recipe.background).image
        found.append(psnr(colour_matched(image.numpy(), target), target))
    return fmean(found)


def colour_matched(image: FloatArray, target: FloatArray) -> FloatArray:
    """Return ``image`` [H, W, 3] under the affine colour map that brings it nearest to ``target``, in [0, 1]."""
    pixels = np.concatenate([image.reshape(-1, 3), np.ones((image[..., 0].size, 1))], 1, dtype=np.float64)
    colours = np.linalg.lstsq(pixels, target.reshape(-1, 3).astype(np.float64), rcond=None)[0]
    return (pixels @ colours).clip(0, 1).astype(np.float32).reshape(image.shape)


def _views(frame: Frame, views: list[int]) -> Frame:
    return replace(frame, images=frame.images[views], cameras=frame.cameras.select(views))
