"""Compiled renderers that let themselves be measured without torch around them.

A plugin offers itself by an entry point of the group ``gsstream.bench``, named like its renderer part::

    [project.entry-points."gsstream.bench"]
    mine = "gsstream_mine.bench"

a module with the functions of :class:`NativeBench` and the class ``Kernel``; it needs no torch. A renderer without one
is measured through its part alone, and without a floor when the machine's peaks are not measured.
"""

from __future__ import annotations

import importlib.metadata
import warnings
from typing import Any, Protocol, cast

from gsstream.core.errors import STRANGERS
from gsstream_lab.bench.roofline import Peak

ENTRY_POINT_GROUP = "gsstream.bench"
MEASURED = 40


class NativeKernel(Protocol):
    """A scene, camera and mask, ready to be drawn again and again."""

    def forward(self) -> Any: ...

    def backward(self) -> Any: ...

    def statistics(self) -> dict[str, int]:
        """Return counts of the last pass; ``memory_bytes`` among them."""


class NativeBench(Protocol):
    """What a module of the group offers.

    ``Kernel(arrays, viewmat, K, width, height, near, tile_mask, active, v_image)`` makes a :class:`NativeKernel`;
    ``active`` are ascending rows that change while the others are cached, or None.
    """

    Kernel: Any

    def instruction_set(self) -> str:
        """Return the instruction set in use."""

    def num_threads(self) -> int: ...

    def set_num_threads(self, n: int) -> None: ...

    def fma_peak(self, threads: int, seconds: float) -> float:
        """Measure 10^9 float32 operations a second, in registers, for so long."""

    def copy_peak(self, threads: int, megabytes: float) -> float:
        """Measure 10^9 bytes read plus written a second, by copying so much a thread."""


def find_native(name: str) -> NativeBench | None:
    """Return the native benchmark of the renderer ``name``, or None; one that fails to load gets a warning."""
    for point in importlib.metadata.entry_points(group=ENTRY_POINT_GROUP, name=name):
        try:
            return cast(NativeBench, point.load())
        except STRANGERS as error:  # third-party code: the renderer can still be measured through its part
            why = f"{type(error).__name__}: {error}"
            warnings.warn(f"the benchmark {name!r} ({point.value}) cannot be loaded: {why}", stacklevel=2)
    return None


def measure_peaks(native: NativeBench | None, threads: tuple[int, ...], known: dict[int, Peak]) -> dict[int, Peak]:
    """Return the better of the peaks known and those measured now: other work only ever lowers them."""
    if native is None:
        return known
    found = dict(known)
    for count in threads:
        # Many short measurements: some of them fall between the work of other programs.
        gflops = max(native.fma_peak(count, 0.004) for _ in range(MEASURED))
        gbytes = max(native.copy_peak(count, 64.0) for _ in range(MEASURED // 4))
        if count in known:
            gflops, gbytes = max(gflops, known[count].gflops), max(gbytes, known[count].gbytes_per_second)
        found[count] = Peak(count, gflops, gbytes)
    return found
