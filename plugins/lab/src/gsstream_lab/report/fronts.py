"""Pareto fronts, their knee, and what one knob buys."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from gsstream_lab.report.groups import Group, is_tie, seed_noise


def pareto_front(points: Sequence[tuple[float, float]]) -> list[int]:
    """Return the indices of (cost, good) points that no other beats in both, by rising cost.

    A point is beaten by one that costs no more and is no worse, and differs from it. Where points are equal, the first
    counts; points with nan are left out.
    """
    known = [i for i, point in enumerate(points) if all(map(math.isfinite, point))]
    front: list[int] = []
    for i in sorted(known, key=lambda i: (points[i][0], -points[i][1], i)):
        if not front or points[i][1] > points[front[-1]][1]:
            front.append(i)
    return front


def knee(front: Sequence[tuple[float, float]]) -> int | None:
    """Return the point of a front furthest above the chord between its ends, cost on a logarithmic scale.

    Both axes run from 0 to 1 over the front ("Kneedle", Satopää et al. 2011, without smoothing). None for fewer than
    three points, a cost that is not positive, or a front with no point above the chord.
    """
    if len(front) < 3 or min(cost for cost, _ in front) <= 0:
        return None
    (low, worst), (high, best) = (math.log(front[0][0]), front[0][1]), (math.log(front[-1][0]), front[-1][1])
    heights = [(good - worst) / (best - worst) - (math.log(cost) - low) / (high - low) for cost, good in front]
    index = max(range(len(front)), key=lambda i: heights[i])
    return index if heights[index] > 1e-9 else None


@dataclass(frozen=True, slots=True)
class Effect:
    """What changing one knob did to each mean; a tie is within the noise between seeds, None: noise unknown."""

    base: Group
    changed: Group
    knob: str
    deltas: Mapping[str, float]
    ties: Mapping[str, bool | None]

    def per(self, good: str, cost: str) -> float:
        """Return dB gained per unit of cost, when both move in the same direction beyond the noise; else nan."""
        gained, paid = self.deltas[good], self.deltas[cost]
        if self.ties[good] or self.ties[cost] or gained * paid <= 0:
            return math.nan
        return gained / paid

    def verdict(self, good: str, cost: str) -> str:
        """Return "buys", "saves", "better and cheaper", "worse and dearer", or which side is a tie."""
        if self.ties[good] and self.ties[cost]:
            return "tie"
        cheaper, dearer = self.deltas[cost] < 0, self.deltas[cost] > 0
        if self.ties[good] or self.deltas[good] == 0:
            return "cheaper, quality tied" if cheaper else "dearer, quality tied" if dearer else "tie"
        better = self.deltas[good] > 0
        if self.ties[cost] or not (cheaper or dearer):
            return "better, cost tied" if better else "worse, cost tied"
        return {
            (True, True): "better and cheaper",
            (True, False): "buys",
            (False, True): "saves",
            (False, False): "worse and dearer",
        }[better, cheaper]


def effects(groups: Sequence[Group], keys: Sequence[str]) -> list[Effect]:
    """Compare each group with those it was changed from (see :func:`_references`).

    These have one axis less, or at its first value, or are the first variant with the same axes.
    """
    noise = {key: seed_noise(groups, key) for key in keys}
    found = []
    for changed in groups:
        for base, knob in _references(changed, groups):
            deltas = {key: changed.mean(key) - base.mean(key) for key in keys}
            ties = {key: is_tie(base, changed, key, noise[key]) for key in keys}
            found.append(Effect(base=base, changed=changed, knob=knob, deltas=deltas, ties=ties))
    return found


def _references(changed: Group, groups: Sequence[Group]) -> list[tuple[Group, str]]:
    """(group it was changed from, name of the knob). An axis is changed from its absence, else from its first value."""
    first: dict[str, Any] = {}
    for group in groups:
        for key, value in group.axes.items() if group.variant == changed.variant else ():
            first.setdefault(key, value)
    out = []
    for key, value in changed.axes.items():
        rest = {k: v for k, v in changed.axes.items() if k != key}
        for axes in (rest, {**rest, key: first[key]}):
            bases = [g for g in groups if g.variant == changed.variant and g.axes == axes]
            if bases and axes != changed.axes:
                out.append((bases[0], f"{key}={value}"))
                break
    lead = groups[0]
    if changed.variant != lead.variant:
        bases = [g for g in groups if g.variant == lead.variant and g.axes == changed.axes]
        out += [(base, f"variant {changed.variant}") for base in bases[:1]]
    return out
