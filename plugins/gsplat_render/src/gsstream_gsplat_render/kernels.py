"""The five functions of gsplat that a render needs, and why they may be missing.

They are used one by one and not through ``gsplat.rasterization``, because that one passes neither a tile mask nor lets
a caller reach the 2-D means before they are drawn.
"""

from __future__ import annotations

import functools
import importlib
import importlib.metadata
import importlib.util
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

from gsstream.api import PluginUnavailable
from gsstream_gsplat_render.toolkit import find_toolkit

#: The versions whose functions these are. From 1.6 on ``spherical_harmonics`` takes other arguments and an alpha is
#: at most 0.99, where our players draw up to 0.999.
LEAST, BELOW = (1, 5, 3), (1, 6)
INSTALL = "pip install 'gsplat>=1.5.3,<1.6'"
INSTALL_NVCC = "pip install " + " ".join(
    f"'nvidia-{name}>=13,<14'" for name in ("cuda-nvcc", "cuda-crt", "nvvm", "cuda-cccl", "cuda-runtime")
)
DECLINE = "or render on the processor: --renderer cpu"


@dataclass(frozen=True, slots=True)
class Kernels:
    """Functions with the signatures of gsplat 1.5: one image at a time, not packed."""

    project: Callable[..., Any]  # ``gsplat.fully_fused_projection``
    harmonics: Callable[..., Any]  # ``gsplat.spherical_harmonics``
    tiles: Callable[..., Any]  # ``gsplat.isect_tiles``
    offsets: Callable[..., Any]  # ``gsplat.isect_offset_encode``
    rasterize: Callable[..., Any]  # ``gsplat.rasterize_to_pixels``


@functools.cache
def load_kernels(device: str) -> Kernels:
    """gsplat's functions, proven to run on ``device``.

    The first call on a machine compiles gsplat's kernels, which takes minutes and needs nvcc; it says so on the error
    output before it begins.

    Raises PluginUnavailable when there is no such GPU, no gsplat or another one, no nvcc, or an nvcc that fails; the
    message says which, and what to do.
    """
    if not torch.cuda.is_available():
        build = f"CUDA {torch.version.cuda}" if torch.version.cuda else "CPU only"
        raise PluginUnavailable(
            f"renderer 'gsplat': expected an NVIDIA GPU that torch can use, found none (torch {torch.__version__}, "
            f"built for {build}); install a CUDA build of torch on a machine with a GPU, {DECLINE}"
        )
    index = torch.device(device).index or 0
    if index >= torch.cuda.device_count():
        raise PluginUnavailable(f"renderer 'gsplat': no GPU {device!r}; this machine has {torch.cuda.device_count()}")
    _check_version()
    nvcc = find_toolkit()
    if nvcc is not None and importlib.util.find_spec("gsplat.csrc") is None:
        print(
            f"gsplat compiles its kernels with {nvcc} where it has not done so yet: some minutes, once", file=sys.stderr
        )
    try:
        gsplat = importlib.import_module("gsplat")
        kernels = Kernels(
            project=gsplat.fully_fused_projection,
            harmonics=gsplat.spherical_harmonics,
            tiles=gsplat.isect_tiles,
            offsets=gsplat.isect_offset_encode,
            rasterize=gsplat.rasterize_to_pixels,
        )
        # gsplat binds its kernels on the first call, so one is made here and not in the middle of a run.
        kernels.harmonics(0, torch.ones(1, 3, device=device), torch.ones(1, 1, 3, device=device))
        torch.cuda.synchronize(device)
    except Exception as error:  # compiling or loading a foreign extension can fail in any way
        raise PluginUnavailable(_why_not(error, str(nvcc) if nvcc else None)) from error
    keep_whole()
    return kernels


def keep_whole() -> None:
    """Have convolutions and products of matrices keep all 23 bits of a float32.

    With 10 bits (TF32) SSIM subtracts squares that are nearly equal, and a residual is not what its packet decodes to.
    Torch has two interfaces for this. The older one does nothing where the newer one was set for all of torch, and
    reading the older raises an error where the two disagree: so both are set, the newer one last.
    """
    cudnn: Any = torch.backends.cudnn
    matmul: Any = torch.backends.cuda.matmul
    cudnn.allow_tf32 = matmul.allow_tf32 = False
    for operation in (cudnn.conv, cudnn.rnn, matmul):
        operation.fp32_precision = "ieee"


def gsplat_version() -> str | None:
    """Return the version of gsplat that is installed; None without one."""
    try:
        return importlib.metadata.version("gsplat")
    except importlib.metadata.PackageNotFoundError:
        return None


def _check_version() -> None:
    found = gsplat_version()
    if found is None:
        raise PluginUnavailable(f"renderer 'gsplat': gsplat is not installed; {INSTALL}, {DECLINE}")
    numbers = tuple(int(part) for part in found.split("+")[0].split(".")[:3] if part.isdigit())
    if not LEAST <= numbers < BELOW:
        raise PluginUnavailable(
            f"renderer 'gsplat': expected gsplat 1.5.3 or a later 1.5, got {found}, whose functions take other "
            f"arguments; {INSTALL}, {DECLINE}"
        )


def _why_not(error: Exception, nvcc: str | None) -> str:
    said = f"({type(error).__name__}: {error})"
    if nvcc is None:
        return (
            "renderer 'gsplat': gsplat's CUDA kernels are not compiled, and no nvcc was found with CUDA's headers "
            f"beside it {said}; "
            f"{INSTALL_NVCC} (of the CUDA that torch is built for: {torch.version.cuda}), {DECLINE}"
        )
    return (
        f"renderer 'gsplat': gsplat's CUDA kernels do not run, though there is {nvcc} {said}. The compiler's own "
        'message is shown by: VERBOSE=1 python -c "from gsplat.cuda._backend import _C". Usual causes: an nvcc of '
        f"another CUDA than torch's ({torch.version.cuda}), or a host compiler that it does not know; {DECLINE}"
    )
