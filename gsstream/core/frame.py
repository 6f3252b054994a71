"""Frame: one instant seen by C cameras; PointCloud: what a recording knows about its geometry."""

from __future__ import annotations

from dataclasses import dataclass

from gsstream.core.cameras import Cameras
from gsstream.core.shapes import FloatArray, check_finite, check_shape


@dataclass(frozen=True, slots=True)
class Frame:
    """One instant.

    Arguments:
        index: position in the stream, from 0.
        timestamp: seconds since the first frame.
        images: [C, H, W, 3] float32 in [0, 1].
        cameras: the C cameras, in the order of ``images``.
        effort: share of the recipe's epochs that this frame is worth, in [0, 1]. A live source lowers it when the run
            falls behind; 0 asks for an empty packet, so that numbering and time go on. Frame 0 is always done in full.
    """

    index: int
    timestamp: float
    images: FloatArray
    cameras: Cameras
    effort: float = 1.0

    def validate(self) -> None:
        """Raise ShapeError when images disagree with the cameras or hold a non-finite value."""
        check_shape("images", self.images, (len(self.cameras), self.cameras.height, self.cameras.width, 3))
        check_finite(f"images of frame {self.index}", self.images)


@dataclass(frozen=True, slots=True)
class PointCloud:
    """P coloured points. ``xyz`` [P, 3] float32 scene units, ``rgb`` [P, 3] float32 in [0, 1]; ``origin``: whence."""

    xyz: FloatArray
    rgb: FloatArray
    origin: str

    def __len__(self) -> int:
        return int(self.xyz.shape[0])
