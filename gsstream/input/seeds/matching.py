"""Feature matches between the images of one instant, found without looking at poses. Needs ``gsstream[sfm]``."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gsstream.core.progress import Tell, silent
from gsstream.core.shapes import FloatArray
from gsstream.input.seeds.sfm import run_pycolmap, write_images


@dataclass(frozen=True, slots=True)
class PairMatches:
    """Matches of two cameras: ``cameras`` (a, b); ``first``, ``second`` [M, 2] pixels, pixel-corner origin."""

    cameras: tuple[int, int]
    first: FloatArray
    second: FloatArray


def match_images(images: FloatArray, *, timeout: float = 900.0, tell: Tell = silent) -> list[PairMatches]:
    """Match SIFT features of all pairs; keep those of one two-view geometry (fundamental matrix or homography).

    The same input gives the same matches. Raises InputError when pycolmap is not installed or its process fails.
    """
    with tempfile.TemporaryDirectory(prefix="gsstream-match-") as name:
        folder = Path(name)
        write_images(folder, images)
        run_pycolmap("match", folder, timeout, tell)
        with np.load(folder / "matches.npz") as result:
            pairs, counts, first, second = (result[key] for key in ("pairs", "counts", "first", "second"))
    ends = np.cumsum(counts)
    return [
        PairMatches((int(a), int(b)), first[end - count : end], second[end - count : end])
        for (a, b), count, end in zip(pairs, counts, ends, strict=True)
    ]
