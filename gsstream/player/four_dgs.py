"""4dgs files: a stream as Gaussians that each live for a while, by the library of the format (extra ``fourdgs``).

A Gaussian that a frame changes ends there, and another one begins. So every frame is what the stream has, and every
Gaussian keeps its harmonics. The format's other model, deltas to key frames, is smaller; the writer of its library
leaves harmonics above degree 0 out of that, and the library's front door refuses to read it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gsstream.core.errors import InputError
from gsstream.core.gaussians import SH0
from gsstream.core.install_hints import install_extra
from gsstream.core.memory import require_memory
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.player.activated import Activated

#: A coefficient above degree 0 is one of 256 steps from -REACH to REACH.
REACH = 4.0
#: Bytes at the peak of the library for every number that is written.
_PEAK = 40


class Lives(NamedTuple):
    """Gaussians and when they live.

    Arguments:
        table: [L, W] float32, columns as those of :func:`_table`.
        first, last: [L] index of the first frame in which each is there, and of the first in which it is not.
    """

    table: FloatArray
    first: IntArray
    last: IntArray


def require_fourdgs() -> None:
    """Raise InputError with what to install where the library of the format is missing."""
    try:
        import fourdgs  # noqa: F401
    except ModuleNotFoundError as error:
        raise InputError(f"writing 4dgs needs the package fourdgs: {install_extra('fourdgs')}") from error


def write_4dgs(
    path: Path,
    frames: Iterable[tuple[Activated, IntArray]],
    times: FloatArray,
    *,
    to_recording: FloatArray,
    said: Callable[[str], None],
) -> None:
    """Write frames, z up; ``times`` [T + 1] seconds from the first, and the end of the last.

    ``frames`` yields scenes, and which row of the scene before each row was (-1: none). What the format cannot hold is
    cut, and said. ``to_recording`` [4, 4], from the file's coordinates to those of the recording, is stated in the
    header, row by row.

    Raises InputError for no Gaussians at all, for a degree that changes, for what would take more memory than
    allowed, and what the library refuses.
    """
    import fourdgs

    table, first, last = lives(frames)
    if len(table) == 0:
        raise InputError("a 4dgs file holds Gaussians, and none of these frames has any")
    colours, coefficients = table[:, 11:14], table[:, 14:]
    cut = (np.abs(colours - 0.5) > 0.5).any(1) | (np.abs(coefficients) > REACH).any(1)
    if cut.any():
        said(
            f"4dgs holds colours of degree 0 from 0 to 1 and coefficients from {-REACH:g} to {REACH:g}: "
            f"{cut.mean():.1%} of the Gaussians were cut to that"
        )
    number = len(table)
    scene = fourdgs.GaussianSet(
        positions=table[:, :3],
        rotations=table[:, 3:7],
        scales=table[:, 7:10],
        colors=np.concatenate([np.clip(colours, 0, 1), table[:, 10:11]], 1),
        motions=np.zeros((number, 3), np.float32),
        mu_t=np.zeros(number, np.float32),
        sigma_t=np.full(number, np.inf, np.float32),
        win_lo=times[first],
        win_hi=times[last],
        sh=np.rint((np.clip(coefficients, -REACH, REACH) + REACH) * (255 / (2 * REACH))).astype(np.uint8),
        sh_degree=round((coefficients.shape[1] / 3 + 1) ** 0.5) - 1,
    )
    facts = {
        "color_space": "srgb-rec709-display",
        "coordinate_system": "z-up-right-handed",
        "source": "gsstream",
        "to_recording": " ".join(map(repr, to_recording.ravel().tolist())),
    }
    options = fourdgs.WriteOptions(metadata=facts, library="gsstream")
    try:
        fourdgs.write(str(path), scene, float(times[-1]), options=options)
    except (fourdgs.FourdgsError, ValueError) as error:  # of numbers beyond 32 bits it says ValueError
        raise InputError(f"the library of 4dgs refuses these frames: {error}; export ply") from error


def lives(frames: Iterable[tuple[Activated, IntArray]]) -> Lives:
    """Return every Gaussian for as long as it is the same, in the order in which they end.

    Raises InputError for a degree that changes and for what would take more memory than allowed.
    """
    live, since = np.empty((0, 0), np.float32), np.empty(0, np.int64)
    ended: list[tuple[FloatArray, IntArray, IntArray]] = []
    held, index = 0, -1
    for index, (splats, source) in enumerate(frames):
        now = _table(splats)
        if index == 0:
            live = now[:0]
        if now.shape[1] != live.shape[1]:
            raise InputError(f"a 4dgs file holds one degree of harmonics, and frame {index} of these has another one")
        goes_on = source >= 0
        goes_on[goes_on] = (live[source[goes_on]] == now[goes_on]).all(1)
        gone = np.ones(len(live), bool)
        gone[source[goes_on]] = False
        ended.append((live[gone], since[gone], np.full(int(gone.sum()), index)))
        before, since = since, np.full(len(now), index)
        since[goes_on] = before[source[goes_on]]
        live = now
        held += ended[-1][0].size
        require_memory(_PEAK * (held + live.size), "writing 4dgs")
    ended.append((live, since, np.full(len(live), index + 1)))
    tables, first, last = zip(*ended, strict=True)
    return Lives(np.concatenate(tables[1:]), np.concatenate(first), np.concatenate(last))


def _table(splats: Activated) -> FloatArray:
    """Return [N, W]: means, quats, scales, opacity, colour of degree 0, then coefficients channel by channel."""
    number, coefficients = splats.harmonics.shape[:2]
    columns = [
        splats.means,
        splats.quats,
        splats.scales,
        splats.opacities[:, None],
        0.5 + SH0 * splats.harmonics[:, 0],
        splats.harmonics[:, 1:].transpose(0, 2, 1).reshape(number, 3 * (coefficients - 1)),
    ]
    return np.concatenate(columns, 1).astype(np.float32)
