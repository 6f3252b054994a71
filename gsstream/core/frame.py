"""Frame: one instant seen by C cameras; PointCloud: what a recording knows about its geometry."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, replace

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.errors import ShapeError
from gsstream.core.shapes import FloatArray, as_array, check_shape
from gsstream.core.storage import packed, unpacked

#: How far outside [0, 1] an image may be: the rounding error of resampling in float32.
ROUNDING = 1e-4


@dataclass(frozen=True, slots=True)
class Arrival:
    """The way a frame of a recording that is still being written arrived."""

    #: When its last image was complete, by the time of modification of that file: seconds since 1970. None when its
    #: files are gone already.
    complete: float | None
    absent: tuple[str, ...] = ()  # training cameras whose image did not come
    waiting: int = 0  # later frames that had come when this one's turn had


@dataclass(frozen=True, slots=True)
class Frame:
    """One instant.

    Arguments:
        index: position in the stream, from 0; a stream may begin later.
        timestamp: seconds since the first frame.
        images: [C, H, W, 3] float32 in [0, 1], as a source reads them, or as they are stored: uint8 of which 255 is
            1.0. :meth:`image` gives float32 of either.
        cameras: the C cameras, in the order of ``images``.
        epoch_scale: share of the recipe's epochs that this frame is worth, in [0, 1]. A live source lowers it when the
            run falls behind; 0 asks for an empty packet, so that numbering and time go on. Frame 0 is always done in
            full.
        arrival: how the frame arrived; None for a recording that is not live.
    """

    index: int
    timestamp: float
    images: FloatArray
    cameras: Cameras
    epoch_scale: float = 1.0
    arrival: Arrival | None = None

    def image(self, view: int) -> FloatArray:
        """Return the image [H, W, 3] of a camera, float32 in [0, 1]."""
        return unpacked(self.images[view])

    def as_float32(self) -> Frame:
        """Return the frame with images of float32, in four times the memory where they are stored as uint8."""
        return self if self.images.dtype == np.float32 else replace(self, images=unpacked(self.images))

    def as_stored(self) -> Frame:
        """Return the frame with images of float32 or uint8; those of float64 are converted, and a warning says so once.

        Raises ShapeError for images of another type.
        """
        images = as_array("images", self.images)
        if images.dtype in (np.float32, np.uint8):
            return self if images is self.images else replace(self, images=images)
        if images.dtype != np.float64:
            raise ShapeError(
                f"images of frame {self.index}: expected float32 in [0, 1], float64 or uint8, got {images.dtype}; "
                "divide them by the value that means white"
            )
        warnings.warn(f"images of {images.dtype} are converted to float32 in [0, 1]", stacklevel=3)
        return replace(self, images=images.astype(np.float32))

    def validate(self) -> None:
        """Raise ShapeError when images disagree with the cameras, or hold a value that no image may have.

        The message names camera, frame and first pixel of a value that is not finite or outside [0, 1].
        """
        check_shape("images", self.images, (len(self.cameras), self.cameras.height, self.cameras.width, 3))
        if self.images.dtype == np.uint8:
            return
        for camera, image in zip(self.cameras.ids, self.images, strict=True):
            # Least and largest value are NaN when any pixel is, and comparing with NaN gives false.
            if image.size and not (float(image.min()) >= -ROUNDING and float(image.max()) <= 1 + ROUNDING):
                self._refuse(camera, image)

    def _refuse(self, camera: str, image: FloatArray) -> None:
        """Say where the first bad pixel of an image is."""
        bad = np.argwhere(~((image >= -ROUNDING) & (image <= 1 + ROUNDING)))
        row, column, channel = (int(i) for i in bad[0])
        raise ShapeError(
            f"images of frame {self.index}, camera {camera!r}: expected values in [0, 1], got "
            f"{image[row, column, channel]} at row {row}, column {column}, channel {channel} ({len(bad)} of "
            f"{image.size} values are bad); check the image file and the value that means white"
        )


def join_frames(train: Frame, test: Frame) -> Frame:
    """Return one instant of training cameras, then of test cameras; the rest is that of the training cameras' frame."""
    images = np.concatenate([train.images, test.images])
    return replace(train, images=images, cameras=train.cameras.joined(test.cameras))


def shrink_frame(frame: Frame, factor: int) -> Frame:
    """Return the frame with pictures ``factor`` times smaller, means over squares; what fills no square is cut off."""
    if factor == 1:
        return frame
    cameras = frame.cameras
    height, width = cameras.height // factor, cameras.width // factor
    images = np.empty((len(cameras), height, width, 3), np.float32)
    for view, out in enumerate(images):
        cut = frame.image(view)[: height * factor, : width * factor]
        # Column by column: a mean over both axes at once takes seven times as long.
        rows = cut.reshape(height, factor, width * factor * 3).sum(1).reshape(height, width, factor, 3)
        out[...] = rows[:, :, 0]
        for column in range(1, factor):
            out += rows[:, :, column]
        out /= factor**2
    # The crop keeps the image corner, so only the size changes before the scale does.
    cameras = replace(cameras, width=width * factor, height=height * factor).scaled(width, height)
    return replace(frame, images=images, cameras=cameras)


@dataclass(frozen=True, slots=True)
class PointCloud:
    """P coloured points.

    Arguments:
        xyz: [P, 3] scene units; float32 in a run, and as exact as its files in a source (far from the origin of its
            coordinates float32 would round).
        rgb: [P, 3] float32 in [0, 1].
        origin: whence.
    """

    xyz: FloatArray
    rgb: FloatArray
    origin: str

    def __len__(self) -> int:
        return int(self.xyz.shape[0])


def packed_frame(frame: Frame) -> Frame:
    """Return the frame as it waits: with images of uint8 where these have the same bits."""
    return replace(frame, images=packed(frame.images))
