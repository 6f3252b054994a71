"""From decoded frames to the pictures that are written: turned, undistorted, of one size, as JPEG."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from gsstream.core.errors import SourceError
from gsstream.core.shapes import FloatArray
from gsstream.input.recordings.calibration import Calibration
from gsstream.input.recordings.lens import Lens, Undistortion, undistortion

#: A bent lens takes none: pictures pass as they are.
PINHOLE = Lens("radial", ())


@dataclass(frozen=True, slots=True)
class CameraPlan:
    """What is done to one camera's pictures, and what they show then."""

    name: str
    K: FloatArray  # [3, 3] pixels, of what is written
    w2c: FloatArray  # [4, 4] world to camera, OpenCV axes
    size: tuple[int, int]  # (width, height) of what is written
    split: str
    rotate: int = 0
    straight: Undistortion | None = None
    gain: tuple[float, float, float] | None = None  # blue, green, red, which what is written is divided by

    def apply(self, pixels: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        """Return [H, W, 3] uint8 as it is written, of upright pixels as they came."""
        out = self._straightened(pixels)
        if self.gain is None:
            return out
        levels = np.clip(np.round(np.arange(256)[:, None] / np.array(self.gain)), 0, 255).astype(np.uint8)
        return np.asarray(cv2.LUT(out, levels[None]))

    def _straightened(self, pixels: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        if self.straight is None:
            return pixels
        if pixels.shape[1::-1] != self.straight.size:
            pixels = cv2.resize(pixels, self.straight.size, interpolation=cv2.INTER_AREA)
        # OpenCV counts from the centre of the first pixel.
        at = (self.straight.places - np.float32(0.5)).astype(np.float32)
        no_second: Any = None  # of two maps; an empty array is not the same, whatever the types of OpenCV say
        return np.asarray(cv2.remap(pixels, at, no_second, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def pixels_of(frame: Any, rotate: int = 0) -> np.ndarray[Any, Any]:
    """Return [H, W, 3] uint8 of a decoded frame, blue first as OpenCV has it, turned ``rotate`` degrees clockwise."""
    pixels = frame.to_ndarray(format="bgr24", threads=1)  # without a pool of threads for each picture
    return np.ascontiguousarray(np.rot90(pixels, -rotate // 90)) if rotate else pixels


def upright_size(size: tuple[int, int], rotate: int) -> tuple[int, int]:
    """Return (width, height) of pictures of ``size`` after turning."""
    return size if rotate % 180 == 0 else (size[1], size[0])


def jpeg(pixels: np.ndarray[Any, Any], quality: int) -> bytes:
    """Return a JPEG file of [H, W, 3] uint8, blue first, whose colours have full resolution."""
    options = [
        cv2.IMWRITE_JPEG_QUALITY,
        quality,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
    ]
    done, data = cv2.imencode(".jpg", pixels, options)
    assert done, "OpenCV writes every picture of 8 bits"
    return data.tobytes()


def planned(
    names: list[str], rotations: list[int], calibration: Calibration, sizes: list[tuple[int, int]], where: str
) -> list[CameraPlan]:
    """Return what is done to each camera's pictures, which come in ``sizes`` and are upright after ``rotations``.

    All are written in the smallest size in the calibration. Raises SourceError where a camera's pictures show another
    part of the view than those that it was calibrated with.
    """
    rig = calibration.train.joined(calibration.test)
    upright = [upright_size(size, turn) for size, turn in zip(sizes, rotations, strict=True)]
    for name, size in zip(names, upright, strict=True):
        declared = calibration.sizes[name]
        if abs(size[0] * declared[1] - size[1] * declared[0]) > max(*size, *declared):
            raise SourceError(
                f"camera {name!r} sends pictures of {size[0]} x {size[1]}, {where} is for {declared[0]} x "
                f"{declared[1]}, another part of the view: set its resolution, or its 'rotate'"
            )
    target = min(upright, key=lambda size: size[0] * size[1])
    plans = []
    for name, size, turn in zip(names, upright, rotations, strict=True):
        row, declared = rig.ids.index(name), calibration.sizes[name]
        K = np.diag([size[0] / declared[0], size[1] / declared[1], 1.0]) @ rig.Ks[row]
        lens = calibration.lenses.get(name, PINHOLE)
        bent = size != target or not lens.is_identity
        straight = undistortion(lens, K, size, target, where) if bent else None
        split = "train" if name in calibration.train.ids else "test"
        shown = K if straight is None else straight.K
        plans.append(CameraPlan(name, shown, rig.viewmats[row], target, split, turn, straight))
    return plans
