"""One calibrated camera, as the readers of calibrations give it, and which pictures are its."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from gsstream.core.errors import SourceError
from gsstream.core.shapes import FloatArray
from gsstream.input.recordings.lens import Lens

#: Pictures of a size that differs by less than this share lost or gained a border, and were not scaled.
BORDER = 0.03


@dataclass(frozen=True, slots=True)
class RigCamera:
    """Pose and lens."""

    name: str  # in the calibration; that of the pictures may differ
    w2c: FloatArray  # [4, 4] world to camera, OpenCV axes
    #: [3, 3] pixels, corner origin; without a size: in units of the longer side, from the middle of the picture.
    K: FloatArray
    lens: Lens  # how rays bend
    size: tuple[int, int] | None  # (width, height) that K is for; None: not stored

    def intrinsics(self, size: tuple[int, int]) -> FloatArray:
        """Return K for pictures of this size. Raises SourceError when they show another part of the view."""
        if self.size is None:
            out: FloatArray = np.diag([max(size), max(size), 1.0]) @ self.K
            out[:2, 2] += np.array(size) / 2
            return out
        across, down = size[0] / self.size[0], size[1] / self.size[1]
        if abs(across - down) < 1e-3 * down:
            scaled: FloatArray = np.diag([across, down, 1.0]) @ self.K
            return scaled
        if max(abs(across - 1), abs(down - 1)) < BORDER:
            return self.K
        raise SourceError(
            f"camera {self.name!r} is calibrated for pictures of {self.size[0]} x {self.size[1]}, but those found are "
            f"{size[0]} x {size[1]}: another part of the view; calibrate with pictures of that shape"
        )


def opencv_lens(values: Sequence[float], fisheye: bool, where: str) -> Lens:
    """Return the lens of OpenCV's coefficients: k1, k2, p1, p2, k3, k4, k5, k6, or k1 to k4 of a fisheye."""
    if fisheye and len(values) == 4:
        return Lens("fisheye", tuple(values))
    if fisheye or any(values[8:]) or len(values) in (1, 2, 3):
        kind = "4 coefficients of a fisheye" if fisheye else "0, 4, 5 or 8 coefficients (k1, k2, p1, p2, k3 to k6)"
        raise SourceError(f"{where}: expected {kind}, got {list(values)}")
    k1, k2, p1, p2, *more = (*values, 0.0, 0.0, 0.0, 0.0)[: max(4, len(values))]
    return Lens("radial", (k1, k2, *more[:4]), (p1, p2))


def matched(calibrated: Sequence[str], pictures: Sequence[str]) -> dict[str, str]:
    """Return name of pictures -> name in the calibration: equal, else alike but for signs, else of one number.

    Raises SourceError when some pictures have no calibration.
    """
    rules: tuple[Callable[[str], str], ...] = (
        lambda name: name,
        lambda name: re.sub(r"[^a-z0-9]", "", name.lower().rsplit(".", 1)[0]),
        lambda name: str(int((re.findall(r"\d+", name) or ["-1"])[0])),
    )
    for rule in rules:
        known = {rule(name): name for name in calibrated}
        found = {name: known[rule(name)] for name in pictures if rule(name) in known}
        if len(known) == len(calibrated) and len(found) == len(pictures) == len(set(found.values())):
            return found
    raise SourceError(
        f"the cameras of the calibration ({', '.join(calibrated)}) do not fit the pictures ({', '.join(pictures)}): "
        "name videos or folders of pictures as the calibration names its cameras"
    )
