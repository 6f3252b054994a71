"""The cameras of a rig on the device of the kernels, made once."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch

from gsstream.api import Cameras
from gsstream.replay import Recorder, Records, recorder_on
from gsstream_gsplat_render.fused import load_fused
from gsstream_gsplat_render.placed import ROWS_IN_TORCH, RowKernels
from gsstream_gsplat_render.tiles import IN_TORCH, TILE, Grid, TileKernels

Background = tuple[float, float, float]
#: Entries of the lists of tiles: room beyond what was seen, and the unit in which lists grow.
ROOM, LEAST = 1.25, 1 << 16
#: Rigs that are kept: the sizes of the pictures of frame 0, and that of half size that depth is drawn in.
KEPT = 8


@dataclass(frozen=True, slots=True)
class Target:
    """V cameras of one size, mostly one, and their background on the device.

    ``viewmat`` [V, 4, 4], ``K`` [V, 3, 3], ``background`` [V, 3], ``centre`` [V, 1, 3] of the cameras, all float32.
    """

    viewmat: torch.Tensor
    K: torch.Tensor
    background: torch.Tensor
    centre: torch.Tensor
    width: int
    height: int
    near: float

    @property
    def tiles(self) -> tuple[int, int]:
        """Tile rows and columns; partial tiles count."""
        return tiles_of(self)


def tiles_of(picture: Target | Cameras) -> tuple[int, int]:
    """Return tile rows and columns; partial tiles count."""
    return -(-picture.height // TILE), -(-picture.width // TILE)


class Rig:
    """Cameras before a background, on a device.

    Indexed by the number of the view, it gives a :class:`Target` that is copied to the device when it is first asked
    for.
    """

    def __init__(
        self,
        cameras: Cameras,
        background: Background,
        device: torch.device,
        recorder: Recorder | None,
        kernels: TileKernels,
    ) -> None:
        self.cameras, self.background, self.device, self._kernels = cameras, background, device, kernels
        self._targets: dict[int, Target] = {}
        self._numbers: dict[int, torch.Tensor] = {}
        self.recorder = recorder
        #: Of scenes of which every row changes; those of a narrowed one are its session's.
        self.records = None if recorder is None else Records(recorder, room=self)
        self._entries, self._grid = 0, self._grid_of(LEAST)

    def __getitem__(self, view: int) -> Target:
        if view not in self._targets:
            cameras = self.cameras
            viewmat = torch.as_tensor(cameras.viewmats[view], dtype=torch.float32)
            centre = -(viewmat[:3, :3].T @ viewmat[:3, 3])
            self._targets[view] = Target(
                viewmat=viewmat[None].to(self.device),
                K=torch.as_tensor(cameras.Ks[view], dtype=torch.float32)[None].to(self.device),
                background=torch.tensor([self.background], dtype=torch.float32).to(self.device),
                centre=centre[None, None].to(self.device),
                width=cameras.width,
                height=cameras.height,
                near=cameras.near_plane,
            )
        return self._targets[view]

    def together(self, views: Sequence[int]) -> Target:
        """Return these cameras as one target, whose views are drawn in one call."""
        targets = [self[view] for view in views]
        return replace(
            targets[0],
            viewmat=torch.cat([each.viewmat for each in targets]),
            K=torch.cat([each.K for each in targets]),
            background=torch.cat([each.background for each in targets]),
            centre=torch.cat([each.centre for each in targets]),
        )

    def numbers(self, view: int) -> torch.Tensor:
        """Return [14] float64: rotation of a camera row by row, offset, focal lengths."""
        if view not in self._numbers:
            pose, focal = torch.as_tensor(self.cameras.viewmats[view]), torch.as_tensor(self.cameras.Ks[view])
            found = torch.cat([pose[:3, :3].flatten(), pose[:3, 3], focal.diagonal()[:2]]).double()
            self._numbers[view] = found.to(self.device)
        return self._numbers[view]

    @property
    def grid(self) -> Grid:
        """What lists of tiles need; it has room for half as many entries again as were ever seen."""
        if self._entries > self._grid.capacity / ROOM:
            self._grid = self._grid_of(-(-int(self._entries * ROOM**2) // LEAST) * LEAST)
        return self._grid

    def _grid_of(self, capacity: int) -> Grid:
        return Grid(*tiles_of(self.cameras), capacity=capacity, device=self.device, kernels=self._kernels)

    def count(self, entries: int) -> None:
        """Take note of how many entries a view needed."""
        self._entries = max(self._entries, entries)

    def suffices(self) -> torch.Tensor:
        return self._grid.most <= self._grid.capacity

    def grow(self) -> None:
        self.count(int(self._grid.most))

    @property
    def is_measured(self) -> bool:
        """Whether a view was drawn, so that the size of the lists is no guess."""
        return self._entries > 0


class Rigs:
    """The rigs that were drawn last on a device, so that one that is drawn again is not copied again.

    ``recorder``: of the device; None: nothing is recorded there. ``kernels``: that sort into tiles. ``rows``: that put
    rows into a scene.
    """

    def __init__(
        self,
        device: torch.device,
        recorder: Recorder | None = None,
        kernels: TileKernels = IN_TORCH,
        rows: RowKernels = ROWS_IN_TORCH,
    ) -> None:
        self.device, self.recorder, self.kernels, self.rows = device, recorder, kernels, rows
        self._last: list[Rig] = []

    def find(self, cameras: Cameras, background: Background) -> Rig:
        """Return the rig of these very cameras, from the last few that were asked for or made anew."""
        for rig in self._last:
            if rig.background == background and (rig.cameras is cameras or _same(rig.cameras, cameras)):
                return rig
        made = Rig(cameras, background, self.device, recorder=self.recorder, kernels=self.kernels)
        self._last = [made, *self._last[: KEPT - 1]]
        return self._last[0]


def _same(one: Cameras, other: Cameras) -> bool:
    """Sources make the cameras of every frame anew."""
    sizes = [(rig.width, rig.height, rig.near_plane, rig.viewmats.shape) for rig in (one, other)]
    return sizes[0] == sizes[1] and bool((one.viewmats == other.viewmats).all() and (one.Ks == other.Ks).all())


@functools.cache
def rigs_on(device: str) -> Rigs:
    """Return the rigs of a device; all renderers that work on it share them."""
    place = torch.empty(0, device=device).device  # with its number, as tensors that lie there have it
    fused = load_fused(device)
    if fused is None:
        return Rigs(place, recorder_on(place))
    return Rigs(place, recorder_on(place), fused.tiles, fused.rows)
