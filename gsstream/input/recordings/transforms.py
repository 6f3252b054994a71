"""Which cameras train and which test, by the options of a recipe."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.errors import SourceError
from gsstream.core.shapes import FloatArray
from gsstream.input.recordings.options import DataOptions


def known_camera(key: str, name: str, ids: Sequence[str], taken: Sequence[str] | dict[str, int]) -> str:
    """Return the name of a camera. Raises SourceError, naming the option, for one that is unknown or given before."""
    if name not in ids:
        raise SourceError(f"{key}: no camera {name!r}; cameras: {', '.join(ids)}")
    if name in taken:
        raise SourceError(f"{key}: camera {name!r} is given twice")
    return name


class ChosenSplit(NamedTuple):
    """Ids of the cameras that train, of the test cameras, and of those that a run must see nothing of."""

    train: tuple[str, ...]
    test: tuple[str, ...]
    away: tuple[str, ...] = ()


def choose_split(options: DataOptions, train: Cameras, test: Cameras) -> ChosenSplit:
    """Return the training and test cameras that the options ask for. Raises SourceError where they cannot be so."""
    ids = (*train.ids, *test.ids)
    tests = test.ids if options.test_cameras is None else _named("data.test_cameras", options.test_cameras, ids)
    left = tuple(i for i in ids if i not in tests)
    trains = left if options.train_cameras is None else _named("data.train_cameras", options.train_cameras, ids)
    if both := [i for i in trains if i in tests]:
        raise SourceError(
            f"data.train_cameras: {', '.join(both)} would train and test; name other cameras, or say "
            "data.leak=training if that is meant"
        )
    if options.train_views is not None:
        trains = _far_apart(trains, options.train_views, train, test)
    if options.split == "tuning":
        return _for_tuning(options, trains, tests, _centers(trains, train, test))
    if options.leak == "training":
        trains = (*trains, *tests)
    if not trains:
        raise SourceError(f"data: no training camera is left; test cameras: {', '.join(tests)}")
    return ChosenSplit(trains, tests)


#: One training camera in so many is a test camera in the tuning split, rounded to the nearest number, and at least one.
TRAINING_PER_HELD_OUT = 6


def _for_tuning(
    options: DataOptions, trains: tuple[str, ...], tests: tuple[str, ...], centers: FloatArray
) -> ChosenSplit:
    """The tuning split of a reporting split; ``centers`` [T, 3] are those of its training cameras."""
    if options.leak != "none":
        raise SourceError(
            f"data.split: the tuning split takes the test cameras away, got data.leak={options.leak}, which uses "
            "them; choose settings with data.leak=none"
        )
    if len(trains) < 2:
        raise SourceError(
            f"data.split: the tuning split needs two training cameras, of which one is to test; got {len(trains)}"
        )
    count = max(1, (len(trains) + TRAINING_PER_HELD_OUT // 2) // TRAINING_PER_HELD_OUT)
    held_out = [trains[i] for i in _medoids(centers, count)]
    return ChosenSplit(tuple(i for i in trains if i not in held_out), tuple(held_out), tests)


def _medoids(centers: FloatArray, count: int) -> list[int]:
    """Rows of ``count`` of the points to which the others are nearest (k-medoids by swaps), in order.

    Cameras that lie farthest apart would be the rim of the rig, where no training camera is left around them. Medoids
    are spread over the whole rig and lie in the middle of their neighbours, as test cameras usually do.
    """
    apart = np.linalg.norm(centers[:, None].astype(np.float64) - centers[None], axis=2)
    rows = range(len(centers))

    def cost(chosen: list[int]) -> float:
        return float(apart[:, chosen].min(1).sum())

    chosen: list[int] = []
    for _ in range(count):
        chosen.append(min((i for i in rows if i not in chosen), key=lambda i: cost([*chosen, i])))
    # A swap has to gain more than rounding, so that it ends and cameras in regular rows give the same answer anywhere.
    while True:
        swaps = [[*chosen[:k], i, *chosen[k + 1 :]] for k in range(count) for i in rows if i not in chosen]
        best = min(swaps, key=cost, default=chosen)
        if cost(best) >= cost(chosen) * (1 - 1e-6):
            return sorted(chosen)
        chosen = best


def _named(key: str, wanted: tuple[str, ...], ids: tuple[str, ...]) -> tuple[str, ...]:
    for position, name in enumerate(wanted):
        known_camera(key, name, ids, wanted[:position])
    return wanted


def _far_apart(names: tuple[str, ...], count: int, train: Cameras, test: Cameras) -> tuple[str, ...]:
    """The first ``count`` cameras of a farthest-point order, so that fewer views are a subset of more; in rig order."""
    if count > len(names):
        raise SourceError(f"data.train_views: there are only {len(names)} training cameras, got {count}")
    centers = _centers(names, train, test)
    chosen = [int(np.linalg.norm(centers - centers.mean(0), axis=1).argmin())]
    while len(chosen) < count:
        gaps = np.linalg.norm(centers[:, None] - centers[None, chosen], axis=2).min(1)
        gaps[chosen] = -1  # cameras may share a place
        chosen.append(int(gaps.argmax()))
    return tuple(names[i] for i in sorted(chosen))


def _centers(names: tuple[str, ...], train: Cameras, test: Cameras) -> FloatArray:
    places = dict(zip((*train.ids, *test.ids), np.concatenate([train.centers, test.centers]), strict=True))
    return np.array([places[name] for name in names]).reshape(-1, 3)
