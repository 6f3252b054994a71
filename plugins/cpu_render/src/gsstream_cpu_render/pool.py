"""Idle rasterisers, kept for their scratch memory: allocating it anew costs as much as a small render."""

from __future__ import annotations

import threading
import weakref
from abc import ABC, abstractmethod
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from gsstream_cpu_render import _native
from gsstream_cpu_render.arrays import Float32, SplatArrays
from gsstream_cpu_render.rasterizer import NumpyRasterizer
from gsstream_cpu_render.view import Background

MAX_IDLE = 32

#: Reentrant: the garbage collector may run while a thread holds the lock, and then returns a rasteriser to the pool.
_lock = threading.RLock()
_idle: list[Any] = []


class Rig(Protocol):
    """The attributes of gsstream's Cameras that are needed."""

    @property
    def viewmats(self) -> NDArray[np.floating[Any]]: ...
    @property
    def Ks(self) -> NDArray[np.floating[Any]]: ...
    @property
    def width(self) -> int: ...
    @property
    def height(self) -> int: ...
    @property
    def near_plane(self) -> float: ...


class Passes(ABC):
    """A forward and the backward that belongs to it."""

    @abstractmethod
    def forward(self, splats: SplatArrays) -> tuple[Float32, Float32]:
        """Image [H, W, 3] and transmittance [H, W], both owned by the caller."""

    @abstractmethod
    def backward(self, splats: SplatArrays, v_image: Float32, v_alpha: Float32 | None) -> tuple[Float32, ...]:
        """Gradients in the order of SplatGradients. ``splats`` are those of the forward."""


class PooledRasterizer:
    """A rasteriser for one owner; its memory returns to the pool when the last reference to the lease goes.

    With ``own``, the memory of the rasteriser came from the system and goes back there.
    """

    def __init__(self, rasterizer: NumpyRasterizer, own: bool) -> None:
        self.rasterizer = rasterizer
        if not own:
            # Not __del__, which may run after this module's names are gone when Python ends. Nothing needs memory then.
            weakref.finalize(self, _return_to_pool, rasterizer).atexit = False


def _return_to_pool(rasterizer: NumpyRasterizer) -> None:
    native = rasterizer.release()
    with _lock:
        if len(_idle) < MAX_IDLE and native.isa == _native.active_isa():
            _idle.append(native)


def acquire_rasterizer(cameras: Rig, view: int, background: Background, own: bool = False) -> PooledRasterizer:
    """A rasteriser for camera ``view`` of a rig; ``own``: with memory that is not shared or reused."""
    with _lock:
        # An object keeps the kernels of the instruction set it was made for.
        _idle[:] = [native for native in _idle if native.isa == _native.active_isa()]
        native = _idle.pop() if _idle and not own else None
    pose = (cameras.viewmats[view], cameras.Ks[view])
    return PooledRasterizer(
        NumpyRasterizer(*pose, cameras.width, cameras.height, background, cameras.near_plane, native=native), own
    )


def release_idle_memory() -> int:
    """Free the scratch memory of idle rasterisers; returns the bytes freed."""
    with _lock:
        freed = sum(int(native.memory_bytes()) for native in _idle)
        _idle.clear()
    return freed
