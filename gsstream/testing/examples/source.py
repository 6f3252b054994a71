"""A recording in memory: a white square crosses a black wall."""

from __future__ import annotations

import numpy as np

from gsstream.api import Cameras, Frame, PointCloud, Source, SourceError, SourceInfo

SIZE, FRAMES = 32, 5


def rig(ids: tuple[str, ...], size: int) -> Cameras:
    """Return cameras side by side, a tenth of a unit apart, that look at the wall two units away."""
    viewmats = np.tile(np.eye(4), (len(ids), 1, 1))
    viewmats[:, 0, 3] = [0.1 * place for place in range(len(ids))]
    K = np.array([[1.25 * size, 0, size / 2], [0, 1.25 * size, size / 2], [0, 0, 1]])
    return Cameras(ids=ids, viewmats=viewmats, Ks=np.tile(K, (len(ids), 1, 1)), width=size, height=size)


class ExampleSource(Source):
    """Opened as ``NAME:ANYTHING``; replace what is drawn in ``image`` by what you read."""

    def __init__(self, uri: str, scale: float) -> None:
        if not 0 < scale <= 1 or (scale * SIZE) % 1:
            raise SourceError(f"{uri}: scale {scale} gives no whole number of pixels; expected 1, 0.5 or 0.25")
        self.size = int(scale * SIZE)
        train, test = rig(("left", "middle", "right"), self.size), rig(("test",), self.size)
        self._info = SourceInfo(
            name="square",
            uri=uri,
            num_frames=FRAMES,
            fps=30.0,
            train=train,
            test=test,
            licence="made here, free for any use",
        )

    @property
    def info(self) -> SourceInfo:
        """What the recording says about itself; cameras at the size that ``frame`` delivers."""
        return self._info

    def image(self, index: int, camera: str) -> np.ndarray:
        """Return [H, W, 3] float32 in [0, 1]; here every camera sees the same."""
        if not 0 <= index < FRAMES:
            raise SourceError(f"{self.info.uri}: no frame {index}; expected 0 to {FRAMES - 1}")
        picture = np.zeros((self.size, self.size, 3), np.float32)
        left, side = (4 + 3 * index) * self.size // SIZE, self.size // 3
        picture[side : 2 * side, left : left + side] = 1.0
        return picture

    def frame(self, index: int, split: str = "train") -> Frame:
        """Return one instant of all cameras of a split."""
        cameras = self.info.train if split == "train" else self.info.test
        images = np.stack([self.image(index, camera) for camera in cameras.ids])
        return Frame(index, index / self.info.fps, images, cameras)

    @property
    def stores_bytes(self) -> bool:
        """True where all images hold the 256 levels of 8 bits; a budget of memory counts on it."""
        return True

    def points(self, kind: str = "recording") -> PointCloud | None:
        """Return points of frame 0; None where the recording has none: they are then found in the training images."""
        xyz = np.random.default_rng(0).uniform((-0.3, -0.3, 1.7), (0.3, 0.3, 2.3), (50, 3))
        return PointCloud(xyz.astype(np.float32), np.full((50, 3), 0.5, np.float32), "square")

    def close(self) -> None:
        """Release files and threads; here there are none."""
