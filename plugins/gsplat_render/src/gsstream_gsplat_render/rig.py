"""The cameras of a rig on the device of the kernels, made once."""

from __future__ import annotations

import functools
from dataclasses import dataclass

import torch

from gsstream.api import Cameras

TILE = 16
Background = tuple[float, float, float]
#: Rigs that are kept: the sizes of the pictures of frame 0, and that of half size that depth is drawn in.
KEPT = 8


@dataclass(frozen=True, slots=True)
class Target:
    """A camera and its background on the device.

    ``viewmat`` [1, 4, 4], ``K`` [1, 3, 3], ``background`` [1, 3], ``corner`` [2] number of tiles across and down, all
    float32.
    """

    viewmat: torch.Tensor
    K: torch.Tensor
    background: torch.Tensor
    corner: torch.Tensor
    width: int
    height: int
    near: float

    @property
    def tiles(self) -> tuple[int, int]:
        """Tile rows and columns; partial tiles count."""
        return -(-self.height // TILE), -(-self.width // TILE)


class Rig:
    """Cameras before a background, on a device.

    Indexed by the number of the view, it gives a :class:`Target` that is copied to the device when it is first asked
    for.
    """

    def __init__(self, cameras: Cameras, background: Background, device: torch.device) -> None:
        self.cameras, self.background, self.device = cameras, background, device
        self._targets: dict[int, Target] = {}

    def __getitem__(self, view: int) -> Target:
        if view not in self._targets:
            cameras = self.cameras
            tiles = -(-cameras.width // TILE), -(-cameras.height // TILE)
            viewmat, K, background, corner = (
                torch.as_tensor(value, dtype=torch.float32).to(self.device)
                for value in (cameras.viewmats[view], cameras.Ks[view], self.background, tiles)
            )
            size = cameras.width, cameras.height, cameras.near_plane
            self._targets[view] = Target(viewmat[None], K[None], background[None], corner, *size)
        return self._targets[view]


class Rigs:
    """The rigs that were drawn last on a device, so that one that is drawn again is not copied again."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._last: list[Rig] = []

    def find(self, cameras: Cameras, background: Background) -> Rig:
        """Return the rig of these very cameras, from the last few that were asked for or made anew."""
        for rig in self._last:
            if rig.background == background and (rig.cameras is cameras or _same(rig.cameras, cameras)):
                return rig
        self._last = [Rig(cameras, background, self.device), *self._last[: KEPT - 1]]
        return self._last[0]


def _same(one: Cameras, other: Cameras) -> bool:
    """Sources make the cameras of every frame anew."""
    sizes = [(rig.width, rig.height, rig.near_plane, rig.viewmats.shape) for rig in (one, other)]
    return sizes[0] == sizes[1] and bool((one.viewmats == other.viewmats).all() and (one.Ks == other.Ks).all())


@functools.cache
def rigs_on(device: str) -> Rigs:
    """Return the rigs of a device; all renderers that work on it share them."""
    return Rigs(torch.device(device))
