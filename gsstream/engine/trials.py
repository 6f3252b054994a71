"""``auto`` tried out: short frames 0 without some of the training cameras, judged on those. Ours.

A rule knows the cameras and the seeds, not what they are worth: how many Gaussians a scene can pin down shows in a
camera that nobody fitted. So the rules say where to begin and which way to look, and trials go there step by step while
it gets better. A trial is frame 0 as a run makes it, packet and all, with fewer passes and fewer cameras.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from gsstream.core.auto import Choice
from gsstream.core.errors import ComponentError
from gsstream.core.frame import Frame, PointCloud
from gsstream.core.gaussians import Gaussians
from gsstream.core.rng import Rng
from gsstream.core.shapes import FloatArray
from gsstream.engine.assemble import Assembly, value_at
from gsstream.engine.auto import DEGREE, USUAL_DEGREE, put, settle, taken_over
from gsstream.engine.begin import begin, seeded
from gsstream.engine.facts import scene_facts
from gsstream.engine.guard import guarded
from gsstream.metrics import psnr
from gsstream.packet import PlayerState, StreamMeta
from gsstream.recipe.document import KeyPath

#: What a key packet of half the size is worth, dB. Little, for short fits show only a part of what more coefficients
#: gain in long ones: it decides between choices that are as good.
HALVED = 0.1
#: What a step must gain, dB: left-out cameras of one short fit do not tell less apart.
MARGIN = 0.05
#: Steps without that before a walk turns back: one bad value does not hide a good one behind it.
PATIENCE = 1
#: Training cameras below which none can be spared.
LEAST_CAMERAS = 4


@dataclass(frozen=True, slots=True)
class Trial:
    """What one short frame 0 came to: PSNR of the left-out cameras after the best affine colour map (they have none of
    their own yet), Gaussians, and bytes of the key packet."""

    psnr: float
    gaussians: int
    size: int

    @property
    def score(self) -> float:
        """PSNR less the price of the bytes, dB: what trials are compared by."""
        return self.psnr - HALVED * math.log2(self.size)


def choose(
    parts: Assembly,
    points: Callable[[], PointCloud],
    frame: Frame,
    meta: StreamMeta,
    first: PlayerState | None,
    say: Callable[[str], None],
) -> Assembly:
    """The assembly with every ``auto`` replaced by what this scene decides.

    Rules choose first; where frame 0 is made here and training cameras can be spared, trials go on from there.

    Arguments:
        points: the seeds, made when they are asked for.
        frame: training images of frame 0.
        first: the frame 0 of another stream that is taken over, whose choices stand.
        say: told of every trial.
    """
    usual = usual_values(parts)
    parts = settle(parts, lambda: scene_facts(points(), frame), taken_over(first) if first else {})
    judges = left_out(len(frame.cameras), parts.recipe.first_frame.trial_cameras)
    if first is not None or parts.whole is not None or not judges:
        return parts
    return try_out(parts, usual, FirstFrameTrials(points(), frame, meta, parts.recipe.seed, judges), say)


def usual_values(parts: Assembly) -> dict[str, Any]:
    """What stands in the parts where the recipe says ``auto``, by key: the defaults."""
    usual: dict[str, Any] = {DEGREE: USUAL_DEGREE}
    for slot, *inner in parts.pending:
        if slot != "first_frame":
            config = getattr(parts, slot).config.model_dump()
            usual[".".join((slot, *inner))] = value_at(config, ".".join(inner[1:]))
    return usual


def left_out(count: int, share: float) -> list[int]:
    """Which of ``count`` training cameras trials do without: about that share, evenly spread, never none; empty when
    there are too few to spare one."""
    if count < LEAST_CAMERAS:
        return []
    number = min(max(1, round(share * count)), count // 2)
    return [int((i + 0.5) * count / number) for i in range(number)]


class FirstFrameTrials:
    """Makes trials of one scene; the same anchors and degree are one trial, whatever settings placed them."""

    def __init__(self, points: PointCloud, frame: Frame, meta: StreamMeta, seed: int, judges: list[int]) -> None:
        self._points, self._meta, self._seed = points, meta, seed
        self._fitted = _views(frame, [i for i in range(len(frame.cameras)) if i not in judges])
        self._judges = _views(frame, judges)
        self._known: dict[tuple[int, bytes], Trial] = {}

    def __call__(self, parts: Assembly) -> Trial:
        """The trial of these settings; made anew only when nothing with the same start was."""
        anchors = seeded(parts, self._points, self._fitted)
        key = (parts.recipe.first_frame.degree, anchors.positions.numpy().tobytes())
        if key not in self._known:
            self._known[key] = self._fit(parts)
        return self._known[key]

    def _fit(self, parts: Assembly) -> Trial:
        settings = parts.recipe.first_frame
        brief = settings.model_copy(update={"epochs": min(settings.epochs, settings.trial_epochs)})
        parts = replace(parts, recipe=parts.recipe.model_copy(update={"first_frame": brief}))
        step = begin(parts, self._points, self._fitted, self._meta, Rng(self._seed), lambda *_: None)
        decoded = step.state.player.gaussians
        return Trial(self._judged(parts, decoded.map(torch.from_numpy)), len(decoded), len(step.packet.data))

    def _judged(self, parts: Assembly, gaussians: Gaussians[torch.Tensor]) -> float:
        found = []
        for view, target in enumerate(self._judges.images):
            with torch.no_grad(), guarded("renderer", parts.renderer, self._judges.index):
                image = parts.renderer.render(gaussians, self._judges.cameras, view, parts.recipe.background).image
            found.append(psnr(colour_matched(image.numpy(), target), target))
        return float(np.mean(found))


def colour_matched(image: FloatArray, target: FloatArray) -> FloatArray:
    """``image`` [H, W, 3] under the affine colour map that brings it nearest to ``target``, clipped to [0, 1]."""
    pixels = np.concatenate([image.reshape(-1, 3), np.ones((image[..., 0].size, 1))], 1, dtype=np.float64)
    colours = np.linalg.lstsq(pixels, target.reshape(-1, 3).astype(np.float64), rcond=None)[0]
    return (pixels @ colours).clip(0, 1).astype(np.float32).reshape(image.shape)


def _views(frame: Frame, views: list[int]) -> Frame:
    return replace(frame, images=frame.images[views], cameras=frame.cameras.select(views))


def try_out(
    parts: Assembly, usual: Mapping[str, Any], trial: Callable[[Assembly], Trial], say: Callable[[str], None]
) -> Assembly:
    """The assembly with the choices that have a ladder moved to where short fits are best.

    It starts from the rules' choice or from the usual values, whichever is better. One key after the other, those
    that were chosen last first (they correct what the others left), a value goes up its ladder, or else down, while
    it gains more than ``MARGIN`` within two steps; again from the first key until nothing moves or
    ``first_frame.trials`` are made.

    Arguments:
        parts: settled by the rules (``engine.auto.settle``).
        usual: key -> what it is where nobody says ``auto``.
        trial: what settings come to (``FirstFrameTrials``).
        say: told of every trial.
    """
    if not any(choice.ladder for choice in parts.chosen.values()) or parts.recipe.first_frame.trials == 0:
        return parts
    climb = _Climb(parts, trial, say)
    climb.begin_with(usual)
    while climb.round():
        pass
    return climb.verdict()


@dataclass(frozen=True, slots=True)
class _Tried:
    parts: Assembly
    trial: Trial


class _Climb:
    """The moving state of one search; lives only inside :func:`try_out`."""

    def __init__(self, parts: Assembly, trial: Callable[[Assembly], Trial], say: Callable[[str], None]) -> None:
        self._trial, self._say, self._rules = trial, say, parts.chosen
        self._most = parts.recipe.first_frame.trials
        self._made: list[_Tried] = []
        self._best = self._try(parts, "the rules' choice")

    def begin_with(self, values: Mapping[str, Any]) -> None:
        """Start from these values instead, where they are on their ladders and better than the rules' choice."""
        parts: Assembly | None = self._best.parts
        for key, choice in self._rules.items():
            if choice.ladder and values[key] in choice.ladder and parts is not None:
                parts = _accepted(parts, key, values[key])
        if parts is None or len(self._made) >= self._most:
            return
        found = self._try(parts, "the usual values")
        if found.trial.score > self._best.trial.score:
            self._best = found

    def round(self) -> bool:
        """Walk along every ladder once; whether anything got better and trials are left."""
        before = self._best
        for key, choice in reversed(list(self._rules.items())):
            if choice.ladder and not self._walk(key, choice.ladder, 1):
                self._walk(key, choice.ladder, -1)
        return self._best is not before and len(self._made) < self._most

    def verdict(self) -> Assembly:
        """The best, with the reason behind every value that was tried."""
        parts, found, first = self._best.parts, self._best.trial.psnr, self._made[0].trial.psnr
        for key, choice in self._rules.items():
            if choice.ladder:
                why = f"best of {len(self._made)} trials ({found:.2f} dB on left-out cameras, by rules {first:.2f}); "
                why += f"by rule {choice.value}: {choice.why}"
                parts = put(parts, _path(key), Choice(parts.chosen[key].value, why))
        return parts

    def _walk(self, key: str, ladder: tuple[Any, ...], step: int) -> bool:
        """Go one way along a ladder while it gets better; whether it did."""
        before, best, misses = self._best, self._best, 0
        at = ladder.index(before.parts.chosen[key].value) + step
        while 0 <= at < len(ladder) and len(self._made) < self._most:
            value, at = ladder[at], at + step
            parts = _accepted(before.parts, key, value)
            found = None if parts is None else self._try(parts, f"{key} = {value}")
            if found is None or found.trial is best.trial:
                continue  # not possible together with the other values, or the same scene to start from: look further
            if found.trial.score <= best.trial.score + MARGIN:
                misses += 1
                if misses > PATIENCE:
                    break
            else:
                best, misses = found, 0
        self._best = best
        return best is not before

    def _try(self, parts: Assembly, what: str) -> _Tried:
        tried = _Tried(parts, self._trial(parts))
        if all(tried.trial is not one.trial for one in self._made):
            self._made.append(tried)
            self._say(f"auto: trial {len(self._made)}, {what}: {_said(tried.trial)}")
        return tried


def _accepted(parts: Assembly, key: str, value: Any) -> Assembly | None:
    try:
        return put(parts, _path(key), Choice(value, "tried"))
    except ComponentError:
        return None


def _path(key: str) -> KeyPath:
    return tuple(key.split("."))


def _said(trial: Trial) -> str:
    return f"{trial.psnr:.2f} dB on left-out cameras, {trial.gaussians:,} Gaussians, {trial.size / 1000:.0f} KB"
