"""What keeps gsplat's kernels from running, told apart on stubs of machines that have a GPU; and its signatures."""

from __future__ import annotations

import importlib
import importlib.metadata
import inspect
import os
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gsplat
import pytest
import torch
from gsstream_gsplat_render import kernels
from gsstream_gsplat_render.kernels import Kernels, keep_whole, load_kernels
from gsstream_gsplat_render.rig import Rigs
from gsstream_gsplat_render.splat import composite, project
from test_gsplat_renderer import rig, scene
from torch_kernels import TORCH_KERNELS

from gsstream.api import PluginUnavailable

NAMES = {
    "project": "fully_fused_projection",
    "harmonics": "spherical_harmonics",
    "tiles": "isect_tiles",
    "offsets": "isect_offset_encode",
    "rasterize": "rasterize_to_pixels",
}


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[pytest.MonkeyPatch]:
    """A machine with a GPU, gsplat 1.5.3 and no nvcc. Tensors of the GPU are the processor's."""
    load_kernels.cache_clear()
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(torch.cuda, "synchronize", lambda *_: None)
    ones = torch.ones
    monkeypatch.setattr(torch, "ones", lambda *size, device=None: ones(*size))
    # Kernels that were compiled beforehand are a machine of another kind.
    find = importlib.util.find_spec
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None if name == "gsplat.csrc" else find(name))
    for name in ("CUDA_HOME", "CUDA_PATH", "LIBRARY_PATH"):
        monkeypatch.setenv(name, "")  # so that what is set in between is taken back
        monkeypatch.delenv(name)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr("sysconfig.get_path", lambda *_: str(tmp_path))
    yield monkeypatch
    load_kernels.cache_clear()


def with_functions(monkeypatch: pytest.MonkeyPatch, harmonics: Any) -> None:
    functions = dict.fromkeys(NAMES.values(), TORCH_KERNELS.project) | {"spherical_harmonics": harmonics}
    found, stub = importlib.import_module, SimpleNamespace(**functions)
    monkeypatch.setattr(kernels.importlib, "import_module", lambda name: stub if name == "gsplat" else found(name))


def install_nvcc(root: Path) -> Path:
    """Wheels as NVIDIA lays them out: nvcc, headers, and the runtime under its full name alone."""
    home = root / "nvidia" / "cu13"
    for path in ("bin/nvcc", "include/cuda_runtime.h", "lib/libcudart.so.13"):
        (home / path).parent.mkdir(parents=True, exist_ok=True)
        (home / path).touch()
    return home


def refused(*_: Any, **__: Any) -> Any:
    raise AttributeError("'NoneType' object has no attribute 'spherical_harmonics_fwd'")


def test_all_well(machine: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    home = install_nvcc(tmp_path)
    machine.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    with_functions(machine, lambda *_: None)
    assert isinstance(load_kernels("cuda"), Kernels)
    assert f"gsplat compiles its kernels with {home / 'bin/nvcc'}" in capsys.readouterr().err
    assert os.environ["CUDA_HOME"] == str(home)
    link = Path(os.environ["LIBRARY_PATH"]) / "libcudart.so"
    assert link.resolve() == home / "lib" / "libcudart.so.13"
    assert not torch.backends.cudnn.allow_tf32


BACKENDS = torch.backends
SETTINGS: dict[str, Any] = {
    "nothing": lambda: None,
    "the older interface": lambda: setattr(BACKENDS.cudnn, "allow_tf32", True),
    "the newer one, for convolutions": lambda: setattr(BACKENDS.cudnn.conv, "fp32_precision", "tf32"),
    "the newer one, for all of torch": lambda: setattr(BACKENDS, "fp32_precision", "tf32"),
    "products of matrices": lambda: torch.set_float32_matmul_precision("high"),
}


@pytest.fixture
def precision() -> Iterator[None]:
    yield
    for owner in (BACKENDS, BACKENDS.cudnn, BACKENDS.cuda.matmul):
        owner.fp32_precision = "none"
    BACKENDS.cudnn.allow_tf32, BACKENDS.cuda.matmul.allow_tf32 = True, False


@pytest.mark.usefixtures("precision")
@pytest.mark.parametrize("before", SETTINGS)
def test_no_bits_are_left_out_whatever_was_set_before_and_through_either_interface(before: str) -> None:
    SETTINGS[before]()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        keep_whole()
        assert not BACKENDS.cudnn.allow_tf32
        assert not BACKENDS.cuda.matmul.allow_tf32
        assert BACKENDS.cudnn.conv.fp32_precision == BACKENDS.cuda.matmul.fp32_precision == "ieee"


@pytest.mark.parametrize("version", ["1.6.0", "1.5.2", "2.0"])
def test_another_gsplat(machine: pytest.MonkeyPatch, version: str) -> None:
    machine.setattr(importlib.metadata, "version", lambda _: version)
    with pytest.raises(PluginUnavailable, match=rf"1.5.3 or a later 1.5, got {version}.*--renderer cpu"):
        load_kernels("cuda")


def test_no_gsplat(machine: pytest.MonkeyPatch) -> None:
    machine.setattr(kernels, "gsplat_version", lambda: None)
    with pytest.raises(PluginUnavailable, match=r"gsplat is not installed; pip install 'gsplat>=1.5.3,<1.6'"):
        load_kernels("cuda")


def test_no_nvcc(machine: pytest.MonkeyPatch) -> None:
    with_functions(machine, refused)
    with pytest.raises(PluginUnavailable, match=r"no nvcc was found .*NoneType.*pip install 'nvidia-cuda-nvcc>=13,"):
        load_kernels("cuda")


def test_an_nvcc_that_fails(machine: pytest.MonkeyPatch, tmp_path: Path) -> None:
    nvcc = install_on_path(machine, tmp_path / "own")
    with_functions(machine, refused)
    with pytest.raises(PluginUnavailable, match=rf"do not run, though there is {nvcc} .*VERBOSE=1 python"):
        load_kernels("cuda")


def install_on_path(machine: pytest.MonkeyPatch, home: Path) -> Path:
    """An nvcc of the system that fails, with headers beside it."""
    nvcc, header = home / "bin" / "nvcc", home / "targets" / "x86_64-linux" / "include" / "cuda_runtime.h"
    for path in (nvcc, header):
        path.parent.mkdir(parents=True)
    header.touch()
    nvcc.write_text("#!/bin/sh\nexit 1\n")
    nvcc.chmod(0o755)
    machine.setenv("PATH", str(nvcc.parent))
    return nvcc


def test_an_nvcc_without_headers_is_passed_over(machine: pytest.MonkeyPatch, tmp_path: Path) -> None:
    own = install_on_path(machine, tmp_path / "own")
    assert kernels.find_toolkit() == own
    link = tmp_path / "elsewhere" / "bin" / "nvcc"
    link.parent.mkdir(parents=True)
    link.symlink_to(own)
    machine.setenv("PATH", str(link.parent))
    assert kernels.find_toolkit() == link, "the headers lie beside what it is a link to"
    next(own.parents[1].rglob("cuda_runtime.h")).unlink()
    assert kernels.find_toolkit() is None
    home = install_nvcc(tmp_path)
    assert kernels.find_toolkit() == home / "bin" / "nvcc"
    machine.setenv("CUDA_HOME", str(own.parents[1]))
    assert kernels.find_toolkit() is None


def test_a_toolkit_of_the_users_own_is_left_as_it_is(machine: pytest.MonkeyPatch, tmp_path: Path) -> None:
    home = install_nvcc(tmp_path)
    machine.setenv("CUDA_HOME", str(tmp_path / "own"))
    assert kernels.find_toolkit() is None, "it names one that has no nvcc"
    assert os.environ["CUDA_HOME"] == str(tmp_path / "own")
    machine.setenv("CUDA_HOME", str(home))
    assert kernels.find_toolkit() == home / "bin" / "nvcc"
    assert "LIBRARY_PATH" not in os.environ


def test_every_call_fits_the_signature_of_the_installed_gsplat() -> None:
    """With the arguments that a render gives: another gsplat is noticed where there is no GPU, too."""
    called = set()

    def bound(name: str) -> Any:
        real = inspect.signature(getattr(gsplat, NAMES[name]))

        def call(*args: Any, **kwargs: Any) -> Any:
            real.bind(*args, **kwargs)
            called.add(name)
            return getattr(TORCH_KERNELS, name)(*args, **kwargs)

        return call

    checked = Kernels(**{name: bound(name) for name in NAMES})
    found = Rigs(torch.device("cpu")).find(rig(), (0.0, 0.0, 0.0))
    seen = project(checked, scene(), found[0], found.grid, probe=torch.zeros(len(scene()), 2))
    composite(checked, seen, found[0], found.grid.inside)
    assert called == set(NAMES)
