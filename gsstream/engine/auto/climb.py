"""The search among choices that were tried: one key after the other, along its ladder, while it gets better.

It sees only ``Assembly -> Trial`` (``engine.auto.short_fits``), so it is tested without making one.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from gsstream.core.auto import Choice
from gsstream.core.errors import ComponentError
from gsstream.engine.assembly.assemble import Assembly
from gsstream.engine.auto.rules import put
from gsstream.engine.auto.short_fits import Trial
from gsstream.recipe.document import KeyPath

#: Least gain of a step, dB: smaller differences cannot be told from noise by a few short fits.
MARGIN = 0.05
#: Steps without such a gain after which a search stops: one bad value must not hide a good one behind it.
PATIENCE = 1

#: Makes the trial of settings, given the trial that they have to beat.
Try = Callable[[Assembly, Trial | None], Trial]


def try_out(
    parts: Assembly, usual: Mapping[str, Any], trial: Try, say: Callable[[str], None]
) -> Assembly:
    """Return the assembly with every choice that has a ladder moved to where short fits are best.

    It starts from the rules' choice or from the usual values, whichever is better. One key after the other, those
    that were chosen last first (they correct what the others left), a value goes up its ladder, or else down, while
    it gains more than ``MARGIN`` within two steps; again from the first key until nothing moves or
    ``first_frame.trials`` are made.

    Arguments:
        parts: settled by the rules (``engine.auto.rules.settle``).
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

    def __init__(self, parts: Assembly, trial: Try, say: Callable[[str], None]) -> None:
        self._trial, self._say, self._rules = trial, say, parts.chosen
        self._most = parts.recipe.first_frame.trials
        self._made: list[_Tried] = []
        self._best = self._try(parts, "the rules' choice", None)

    def begin_with(self, values: Mapping[str, Any]) -> None:
        """Start from these values instead, where they are on their ladders and better than the rules' choice."""
        parts: Assembly | None = self._best.parts
        for key, choice in self._rules.items():
            if choice.ladder and values[key] in choice.ladder and parts is not None:
                parts = _accepted(parts, key, values[key])
        if parts is None or len(self._made) >= self._most:
            return
        found = self._try(parts, "the usual values", self._best.trial)
        if found.trial.beats(self._best.trial):
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
            found = None if parts is None else self._try(parts, f"{key} = {value}", best.trial)
            if found is None or found.trial is best.trial:
                continue  # not possible together with the other values, or the same scene to start from: look further
            if not found.trial.beats(best.trial, MARGIN):
                misses += 1
                if misses > PATIENCE:
                    break
            else:
                best, misses = found, 0
        self._best = best
        return best is not before

    def _try(self, parts: Assembly, what: str, best: Trial | None) -> _Tried:
        tried = _Tried(parts, self._trial(parts, best))
        if all(tried.trial is not one.trial for one in self._made):
            self._made.append(tried)
            folds, of = len(tried.trial.folds), len(self._made[0].trial.folds)
            early = f" (given up, {folds} of {of} folds)" if folds < of else ""
            self._say(f"auto: trial {len(self._made)}, {what}: {_said(tried.trial)}{early}")
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
