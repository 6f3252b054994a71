"""Rendered takes of a board whose truth is known, through the real detector: how far off is the rig that is found?

Usage: python -m tools.board_takes [--cameras 12] [--pictures 100] [--close 15] [--noise 2] [--blur 0.7] [--seed 0]

Cameras of 1280 x 720 pixels with bent lenses stand around a place, two metres from it. A board is carried through the
middle, and close to each camera for its lens. Every picture in which a camera may see it is rendered (four samples a
pixel, blur in pixels, noise in levels of 255) and given to the detector; what is found goes through ``gsstream
calibrate board``'s own code. Prints one row of numbers: errors of corners, largest errors of directions, places and
focal lengths, and what the calibration says of itself.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "plugins" / "capture" / "tests"))
SIZE = (1280, 720)


def measured(given: argparse.Namespace) -> dict[str, Any]:
    """Render, detect, calibrate, and compare with the truth."""
    from gsstream_capture.board.solve import solve
    from gsstream_capture.board.takes import Takes
    from test_board_adjust import BOARD, errors, walk

    truth, ideal = walk(given.cameras, given.pictures, noise=0.0, seed=given.seed, close=given.close)
    seen, off = _detected(truth, ideal, given)
    close = [sum(camera == c and picture >= given.pictures for camera, picture in seen) for c in range(given.cameras)]
    names = tuple(f"cam{c:02d}" for c in range(given.cameras))
    sizes = (SIZE,) * given.cameras
    takes = Takes(BOARD, names, sizes, seen, len(truth.boards), given.pictures, tuple(close), {})
    found = solve(takes)
    angle, place, focal = errors(found.solution, truth)
    distances = np.linalg.norm(off, axis=1)
    return {
        "cameras": given.cameras,
        "pictures": len(seen),
        "of_which_close": sum(close),
        "noise_levels": given.noise,
        "blur_px": given.blur,
        "corners": len(off),
        "corners_off_px": round(float(np.sqrt((distances**2).mean())), 3),
        "corners_off_mean_px": round(float(np.abs(off.mean(0)).max()), 3),
        "worst_angle_degrees": round(angle, 4),
        "worst_place_mm": round(1000 * place, 3),
        "worst_focal_%": round(100 * focal, 3),
        "held_out_px": round(float(np.nanmedian(found.held_out)), 3),
        "seed": given.seed,
    }


def _detected(truth: Any, ideal: Any, given: argparse.Namespace) -> tuple[dict[tuple[int, int], Any], Any]:
    """What the detector finds in each picture, and how far that is from the truth, [n, 2] pixels."""
    import board_views
    from gsstream_capture.board.design import Finder
    from gsstream_capture.board.start import matrix
    from test_board_adjust import BOARD

    draw, finder = np.random.default_rng(given.seed + 1), Finder(BOARD)
    seen: dict[tuple[int, int], Any] = {}
    off = []
    for camera, picture in sorted(ideal):
        pose = matrix(truth.cameras[camera]) @ matrix(truth.boards[picture])
        lens = truth.lenses[camera]
        if not any(key[0] == camera for key in seen):
            board_views._rays.cache_clear()  # one camera's directions at a time: they are 44 MB
        shown = board_views.rendered(BOARD, lens, pose, SIZE, draw, noise=given.noise, blur=given.blur)
        if (found := finder.find(shown)) is None:
            continue
        seen[camera, picture] = found
        off.append(found.places - board_views.places_of(BOARD, lens, pose)[found.ids])
    return seen, np.concatenate(off)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run as a command; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cameras", type=int, default=12)
    parser.add_argument("--pictures", type=int, default=100, help="of the walk with the board")
    parser.add_argument("--close", type=int, default=15, help="pictures of each camera's lens take")
    parser.add_argument("--noise", type=float, default=2.0, help="standard deviation, levels of 255")
    parser.add_argument("--blur", type=float, default=0.7, help="standard deviation, pixels")
    parser.add_argument("--seed", type=int, default=0)
    print(json.dumps(measured(parser.parse_args(arguments))))
    return 0


if __name__ == "__main__":
    sys.exit(main())
