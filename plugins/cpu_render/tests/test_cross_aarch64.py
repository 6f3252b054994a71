"""The aarch64 kernels, compiled here and run under an emulator, against the reference and this machine's own kernels.

Skipped where there is no cross compiler or no emulator (``tests/cross/build.py`` says what to install).
"""

from __future__ import annotations

import importlib.util
import os
import struct
import subprocess
from pathlib import Path

import numpy as np
import pytest
import torch
from cpu_scenes import BACKGROUND, GRADIENT_TOLERANCE, HEIGHT, WIDTH, camera, random_splats, reference, relative_error
from gsstream_cpu_render import _native
from gsstream_cpu_render.adam_step import step_table
from gsstream_cpu_render.arrays import SplatArrays
from gsstream_cpu_render.loss import photometric_loss
from gsstream_cpu_render.rasterizer import NumpyRasterizer

from gsstream.backend import AdamState

_spec = importlib.util.spec_from_file_location("cross_build", Path(__file__).parent / "cross" / "build.py")
assert _spec is not None
assert _spec.loader is not None
cross = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(cross)

COMPILER, EMULATOR = cross.found(cross.COMPILERS), cross.found(cross.EMULATORS)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(COMPILER is None, reason="no aarch64 cross compiler (apt install g++-aarch64-linux-gnu)"),
    pytest.mark.skipif(EMULATOR is None, reason="no aarch64 emulator (apt install qemu-user)"),
]

ATTRIBUTES = (*SplatArrays._fields, "means2d")
#: Images: of nearly all values, and of all: where an alpha lies at the cut of 1/255, one draws it and the other not.
CLOSE, CUT = 2e-5, 1 / 255
#: Between two instruction sets: multiplications and additions fuse on aarch64 and do not on the x86 baseline.
SETS = 2e-5

SPLATS = random_splats(400, 5, 9)
ACTIVE = np.arange(3, 400, 7, dtype=np.uint32)
RNG = np.random.default_rng(8)
UPSTREAM = RNG.normal(size=(HEIGHT, WIDTH, 3)).astype(np.float32)
TARGET = RNG.random((HEIGHT, WIDTH, 3), np.float32)


@pytest.fixture(scope="module")
def driver(tmp_path_factory: pytest.TempPathFactory) -> Path:
    assert COMPILER is not None
    built: Path = cross.build(COMPILER, tmp_path_factory.mktemp("cross"))
    return built


def emulate(driver: Path, threads: int) -> dict[str, np.ndarray]:
    """All outputs of the driver on the scene above."""
    viewmat, K = camera()
    arrays = [np.float32(0.01), viewmat, K, np.array(BACKGROUND), *SPLATS, UPSTREAM, TARGET]
    data = np.array([len(SPLATS.means), SPLATS.shN.shape[1], WIDTH, HEIGHT, len(ACTIVE)], np.int32).tobytes()
    data += b"".join(np.ascontiguousarray(array, np.float32).tobytes() for array in arrays) + ACTIVE.tobytes()
    source, result = driver.with_name("input.bin"), driver.with_name(f"output{threads}.bin")
    source.write_bytes(data)
    environment = {**os.environ, "GSSTREAM_THREADS": str(threads)}
    environment.pop("GSSTREAM_ISA", None)
    subprocess.run([str(EMULATOR), str(driver), str(source), str(result)], check=True, env=environment, timeout=120)
    return read(result.read_bytes())


def read(data: bytes) -> dict[str, np.ndarray]:
    found, at = {}, 0
    while at < len(data):
        (length,) = struct.unpack_from("<i", data, at)
        name = data[at + 4 : at + 4 + length].decode()
        (count,) = struct.unpack_from("<q", data, at + 4 + length)
        at += 12 + length
        found[name] = np.frombuffer(data, np.float32, count, at)
        at += 4 * count
    return found


@pytest.fixture(scope="module")
def emulated(driver: Path) -> dict[str, np.ndarray]:
    return emulate(driver, 1)


@pytest.fixture
def baseline():
    _native.select_isa(_native.supported_isas()[0])


def assert_same_picture(got: np.ndarray, want: np.ndarray) -> None:
    difference = np.abs(got - want.ravel())
    assert np.quantile(difference, 0.999) < CLOSE
    assert difference.max() < CUT


def test_everything_is_there_and_finite(emulated: dict[str, np.ndarray]) -> None:
    assert {"image", "transmittance", "loss", "loss gradient", "adam", "active image"} <= set(emulated)
    for name in ATTRIBUTES:
        assert emulated[name].any(), f"gradient of {name} is all zero"
    for name, value in emulated.items():
        assert np.isfinite(value).all(), name


def test_against_the_float64_reference(emulated: dict[str, np.ndarray]) -> None:
    image, transmittance, gradients = reference(SPLATS, UPSTREAM, np.zeros((HEIGHT, WIDTH), np.float32))
    assert_same_picture(emulated["image"], image)
    assert_same_picture(emulated["transmittance"], transmittance)
    for name in ATTRIBUTES:
        want = getattr(gradients, name)
        assert relative_error(emulated[name].reshape(want.shape), want) < GRADIENT_TOLERANCE, name


@pytest.mark.usefixtures("baseline")
def test_against_the_weakest_set_of_this_machine(emulated: dict[str, np.ndarray]) -> None:
    rasterizer = NumpyRasterizer(*camera(), WIDTH, HEIGHT, BACKGROUND)
    image, _ = rasterizer.forward(SPLATS)
    gradients = rasterizer.backward(UPSTREAM)
    assert_same_picture(emulated["image"], image)
    for name in ATTRIBUTES:
        want = getattr(gradients, name)
        assert relative_error(emulated[name].reshape(want.shape), want) < SETS, name
    loss = photometric_loss(image, TARGET, dssim_weight=0.2)
    np.testing.assert_allclose(emulated["loss"], [loss.l1, loss.dssim], rtol=1e-5)
    assert loss.gradient is not None
    assert relative_error(emulated["loss gradient"].reshape(image.shape), loss.gradient) < 1e-4
    means = torch.from_numpy(SPLATS.means.copy())
    state, gradient = AdamState.start(means), torch.from_numpy(emulated["means"].reshape(means.shape).copy())
    for _ in range(3):
        step_table("means", means, gradient, state, 0.01)
    np.testing.assert_allclose(emulated["adam"], means.ravel(), atol=1e-6)
    np.testing.assert_allclose(emulated["adam first"], state.exp_avg.ravel(), rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(emulated["adam second"], state.exp_avg_sq.ravel(), rtol=1e-6, atol=1e-20)


def test_the_incremental_mode_gives_the_same_bits(emulated: dict[str, np.ndarray]) -> None:
    assert emulated["active image"].tobytes() == emulated["image"].tobytes()
    for name in ATTRIBUTES:
        full = emulated[name].reshape(len(SPLATS.means), -1)[ACTIVE]
        assert emulated[f"active {name}"].tobytes() == full.tobytes(), name


def test_any_number_of_threads_gives_the_same_bits(driver: Path, emulated: dict[str, np.ndarray]) -> None:
    for name, value in emulate(driver, 3).items():
        assert value.tobytes() == emulated[name].tobytes(), name
