"""The five functions of gsplat that a render needs, and why they may be missing.

They are used one by one and not through ``gsplat.rasterization``, because that one passes neither a tile mask nor lets
a caller reach the 2-D means before they are drawn.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

from gsstream.api import PluginUnavailable

INSTALL = "pip install 'gsstream-gsplat-render[cuda]'"


@dataclass(frozen=True, slots=True)
class Kernels:
    """Functions with the signatures of gsplat 1.5: one image at a time, not packed.

    Arguments:
        project: ``gsplat.fully_fused_projection``.
        harmonics: ``gsplat.spherical_harmonics``.
        tiles: ``gsplat.isect_tiles``.
        offsets: ``gsplat.isect_offset_encode``.
        rasterize: ``gsplat.rasterize_to_pixels``.
    """

    project: Callable[..., Any]
    harmonics: Callable[..., Any]
    tiles: Callable[..., Any]
    offsets: Callable[..., Any]
    rasterize: Callable[..., Any]


@functools.cache
def load_kernels(device: str) -> Kernels:
    """gsplat's functions, proven to run on ``device``.

    The first call on a machine may compile gsplat's kernels, which takes minutes and needs the CUDA toolkit.

    Raises PluginUnavailable when there is no such GPU, no gsplat, or no compiled kernels; the message says which.
    """
    if not torch.cuda.is_available():
        build = f"CUDA {torch.version.cuda}" if torch.version.cuda else "CPU only"
        raise PluginUnavailable(
            f"renderer 'gsplat': expected an NVIDIA GPU that torch can use, found none (torch {torch.__version__}, "
            f"built for {build}); install a CUDA build of torch on a machine with a GPU, or choose --set renderer=cpu"
        )
    index = torch.device(device).index or 0
    if index >= torch.cuda.device_count():
        raise PluginUnavailable(f"renderer 'gsplat': no GPU {device!r}; this machine has {torch.cuda.device_count()}")
    try:
        gsplat = importlib.import_module("gsplat")
        kernels = Kernels(
            gsplat.fully_fused_projection, gsplat.spherical_harmonics, gsplat.isect_tiles, gsplat.isect_offset_encode,
            gsplat.rasterize_to_pixels,
        )  # fmt: skip
    except (ImportError, AttributeError) as error:
        raise PluginUnavailable(f"renderer 'gsplat': gsplat 1.5 is not installed ({error}); {INSTALL}") from error
    _try(kernels, device)
    return kernels


def _try(kernels: Kernels, device: str) -> None:
    """gsplat binds its kernels on the first call, so one is made here and not in the middle of a run."""
    try:
        kernels.harmonics(0, torch.ones(1, 3, device=device), torch.ones(1, 1, 3, device=device))
        torch.cuda.synchronize(device)
    except Exception as error:  # compiling or loading a foreign extension can fail in any way
        raise PluginUnavailable(
            f"renderer 'gsplat': gsplat's CUDA kernels do not run here ({type(error).__name__}: {error}); install the "
            "CUDA toolkit (nvcc) that fits torch, or a gsplat wheel built for this torch and CUDA"
        ) from error
