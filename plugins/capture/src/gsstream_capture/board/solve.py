"""From what cameras saw of a board to the rig: lenses, poses in metres, and how far both can be trusted."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from gsstream.core.errors import SourceError
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.input.recordings.calibration import SCHEMA
from gsstream_capture.board.adjust import Corners, Solution, adjust, adjust_twice, focal_deviation, residuals
from gsstream_capture.board.start import first_guess, first_lens, matrix, vector
from gsstream_capture.board.takes import Takes

#: Largest standard deviation of a focal length, as a share of the focal length.
SURE = 0.01
#: Every so many pictures of the rig take are kept out of the first adjustment, to be measured with.
HELD = 5
#: Pictures of a lens take without which a principal point is not known: from afar, moving it and turning the camera
#: look the same. Seen: 40 pixels and three degrees for 0.05 pixels of error.
CLOSE = 10


@dataclass(frozen=True, slots=True)
class Calibrated:
    """A rig. Arrays are by camera; ``cameras`` of the solution are world to camera in metres."""

    names: tuple[str, ...]
    sizes: tuple[tuple[int, int], ...]
    solution: Solution
    deviation: FloatArray  # of the focal length, as a share of it
    pictures: IntArray  # in which the board was seen
    rms: FloatArray  # pixels, of the corners that were used
    held_out: FloatArray  # median pixels, of pictures that took no part; NaN where a camera has none
    links: IntArray  # [C, C] pictures that two cameras share
    false: float  # share of the corners that were left out
    #: Cameras without a lens take: their directions may be degrees off, whatever the deviation says.
    loose: tuple[str, ...]


def solve(takes: Takes) -> Calibrated:
    """Calibrate a rig.

    Raises SourceError naming the camera that saw too little of the board, shares too few pictures with the others, or
    whose focal length is not sure to one percent.
    """
    found = solved(takes)
    unsure = [c for c in range(len(found.names)) if not found.deviation[c] <= SURE]
    if unsure:
        listed = ", ".join(f"{found.names[c]!r} {100 * found.deviation[c]:.1f} %" for c in unsure)
        raise SourceError(
            f"the focal length is not sure to {100 * SURE:.0f} %: {listed}; take more pictures of the board close to "
            "these cameras, tilted, and in all corners of their pictures"
        )
    return found


def solved(takes: Takes) -> Calibrated:
    """Return what :func:`solve` does, however unsure it is."""
    names, seen = takes.names, takes.seen
    by_camera = [[one for (camera, _), one in sorted(seen.items()) if camera == c] for c in range(len(names))]
    lenses = np.stack(
        [
            takes.known[c] if c in takes.known else first_lens(takes.board, by_camera[c], takes.sizes[c], names[c])
            for c in range(len(names))
        ]
    )
    start, links = first_guess(takes.board, seen, lenses, names, takes.pictures)
    start = replace(start, known=frozenset(takes.known))
    corners = _corners(takes)
    held = (corners.picture % HELD == HELD - 1) & (corners.picture < takes.rig_pictures)
    half, _ = adjust_twice(start, corners.of(~held))
    held_out = _held_out(half, corners.of(held), len(names))
    solution, kept = adjust_twice(half, corners)
    used = corners.of(kept)
    squares = (residuals(solution, used)[0] ** 2).sum(1)
    count = np.bincount(used.camera, minlength=len(names))
    return Calibrated(
        names,
        takes.sizes,
        _placed(solution, takes),
        focal_deviation(solution, used),
        np.array([len(rows) for rows in by_camera]),
        np.sqrt(np.bincount(used.camera, squares, len(names)) / np.maximum(count, 1)),
        held_out,
        links,
        float(1 - kept.mean()),
        tuple(name for c, name in enumerate(names) if c not in takes.known and takes.lens_pictures[c] < CLOSE),
    )


def _corners(takes: Takes) -> Corners:
    points = takes.board.points
    keys = sorted(takes.seen)
    sizes = [len(takes.seen[key].ids) for key in keys]
    return Corners(
        np.repeat([camera for camera, _ in keys], sizes),
        np.repeat([picture for _, picture in keys], sizes),
        np.concatenate([points[takes.seen[key].ids] for key in keys]),
        np.concatenate([takes.seen[key].places for key in keys]),
    )


def _held_out(half: Solution, corners: Corners, cameras: int) -> FloatArray:
    """Median distance of held-out corners from where the others' cameras say that they are, by camera, pixels.

    The board's pose in such a picture is fitted to the other cameras alone.
    """
    off: list[list[float]] = [[] for _ in range(cameras)]
    for picture in np.unique(corners.picture):
        here = corners.of(corners.picture == picture)
        here = Corners(here.camera, np.zeros_like(here.picture), here.point, here.place)
        start = replace(half, boards=half.boards[picture : picture + 1])
        for camera in np.unique(here.camera):
            others = here.of(here.camera != camera)
            if len(others.camera) < 8:
                continue
            fitted = adjust(start, others, rig=False)
            rest = residuals(fitted, here.of(here.camera == camera))[0]
            off[camera] += np.linalg.norm(rest, axis=1).tolist()
    return np.array([np.median(one) if one else np.nan for one in off])


def _placed(solution: Solution, takes: Takes) -> Solution:
    """Put the world where the board lay last: origin at its corner, x and y along it, z into what it lies on."""
    counts = np.bincount([p for _, p in takes.seen if p < takes.rig_pictures], minlength=takes.rig_pictures)
    last = int(np.flatnonzero(counts >= min(2, counts.max()))[-1])
    to_world = matrix(solution.boards[last])
    cameras = np.stack([vector(matrix(pose) @ to_world) for pose in solution.cameras])
    boards = np.stack([vector(np.linalg.inv(to_world) @ matrix(pose)) for pose in solution.boards])
    return replace(solution, cameras=cameras, boards=boards)


def write(found: Calibrated, path: Path, fps: float) -> None:
    """Write ``cameras.json``, in metres."""
    rows = [
        camera_row(name, size, lens=lens, w2c=matrix(pose))
        for name, size, lens, pose in zip(
            found.names, found.sizes, found.solution.lenses, found.solution.cameras, strict=True
        )
    ]
    write_cameras(path, rows, fps=fps, units="metres")


def camera_row(name: str, size: tuple[int, int], *, lens: FloatArray, w2c: FloatArray) -> dict[str, Any]:
    """Return a camera of ``cameras.json`` for pictures as they come; ``lens`` [9] as the adjustment has it."""
    fx, fy, cx, cy, *bent = (float(value) for value in lens)
    return {
        "id": name,
        "width": size[0],
        "height": size[1],
        "K": [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]],
        "distortion": bent,
        "w2c": w2c.tolist(),
        "frames": f"{name}/%06d.jpg",
    }


def write_cameras(path: Path, rows: Sequence[dict[str, Any]], *, fps: float, units: str) -> None:
    """Write ``cameras.json``."""
    data = {"schema": SCHEMA, "fps": fps, "units": units, "cameras": rows}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")


def report(found: Calibrated) -> str:
    """Return the table of a calibration, and who saw the board together."""
    rows = [("camera", "pictures", "focal, px", "sure to", "rms, px", "held out, px", "most shared with")]
    for c, name in enumerate(found.names):
        links = found.links[c].copy()
        links[c] = -1
        other = int(links.argmax())
        rows.append(
            (
                name,
                str(found.pictures[c]),
                f"{found.solution.lenses[c, :2].mean():.1f}",
                f"{100 * found.deviation[c]:.2f} %",
                f"{found.rms[c]:.2f}",
                f"{found.held_out[c]:.2f}",
                f"{found.names[other]} ({links[other]})",
            )
        )
    lines = _table(rows)
    lines.append(f"{100 * found.false:.1f} % of the corners were left out; held out: predicted by the other cameras")
    if found.loose:
        lines.append(
            f"WARNING: no lens take of {', '.join(found.loose)}: their directions may be some degrees off, however "
            "small the errors are. Take one close to each camera"
        )
    return "\n".join([*lines, "", *_graph(found)])


def _graph(found: Calibrated) -> list[str]:
    rows = [("pictures shared", *found.names)]
    rows += [(name, *map(str, found.links[c])) for c, name in enumerate(found.names)]
    return _table(rows)


def _table(rows: Sequence[tuple[str, ...]]) -> list[str]:
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
