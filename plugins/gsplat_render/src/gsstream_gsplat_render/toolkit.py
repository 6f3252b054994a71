"""The CUDA toolkit with which gsplat compiles its kernels, where it came by wheels.

gsplat from the package index is source: its import compiles 29 files once, with nvcc. The extra ``cuda`` brings nvcc as
wheels, whose folder nobody else looks for; ``find_toolkit`` tells torch of it.
"""

from __future__ import annotations

import os
import shutil
import sysconfig
from collections.abc import MutableMapping
from pathlib import Path


def find_toolkit(
    environment: MutableMapping[str, str] = os.environ, packages: Path | None = None, links: Path | None = None
) -> Path | None:
    """Return the nvcc that gsplat will compile with, and set CUDA_HOME where it came by wheels; None without any.

    An nvcc without CUDA's headers beside it compiles nothing: it is passed over.

    Arguments:
        environment: a user's own CUDA_HOME, or nvcc on the PATH, is left as it is.
        packages: where wheels are installed; default: those of this interpreter.
        links: folder for a link to the runtime library under the name that linkers look for; default: in the user's
            cache.
    """
    home = environment.get("CUDA_HOME") or environment.get("CUDA_PATH")
    if home:
        nvcc = Path(home) / "bin" / "nvcc"
        return nvcc if nvcc.is_file() and _has_headers(nvcc) else None
    on_path = shutil.which("nvcc", path=environment.get("PATH", ""))
    if on_path and _has_headers(Path(on_path)):
        return Path(on_path)
    root = (packages or Path(sysconfig.get_path("purelib"))) / "nvidia"
    for nvcc in filter(_has_headers, sorted(root.glob("cu*/bin/nvcc"), reverse=True)):
        environment["CUDA_HOME"] = str(nvcc.parents[1])
        _link_runtime(nvcc.parents[1], environment, links)
        return nvcc
    return None


def _has_headers(nvcc: Path) -> bool:
    """Whether the headers of CUDA's runtime lie where this nvcc, or the one that it is a link to, looks for them."""
    homes = {place.parent.parent for place in (nvcc, nvcc.resolve())}
    folders = [folder for home in homes for folder in (home / "include", *home.glob("targets/*/include"))]
    return any((folder / "cuda_runtime.h").is_file() for folder in folders)


def _link_runtime(home: Path, environment: MutableMapping[str, str], links: Path | None) -> None:
    """Let ``-lcudart`` find the runtime: wheels have it only under its full name, libcudart.so.13, in ``lib``."""
    found = sorted((home / "lib").glob("libcudart.so.*"))
    if not found:
        return
    cache = environment.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    folder = links or Path(cache) / "gsstream" / home.name
    folder.mkdir(parents=True, exist_ok=True)
    link = folder / "libcudart.so"
    if not (link.exists() and link.resolve() == found[0].resolve()):
        link.unlink(missing_ok=True)
        link.symlink_to(found[0])
    before = environment.get("LIBRARY_PATH")
    environment["LIBRARY_PATH"] = str(folder) if not before else f"{folder}{os.pathsep}{before}"
