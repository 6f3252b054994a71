"""The thread pool under load, and the environment variable that sizes it."""

from __future__ import annotations

import multiprocessing
import os
import subprocess
import sys
import threading

import numpy as np
import pytest
from cpu_scenes import HEIGHT, WIDTH, camera, random_splats, upstream
from gsstream_cpu_render import _native
from gsstream_cpu_render.bench import Kernel, copy_peak, fma_peak
from gsstream_cpu_render.threads import num_threads, set_num_threads

from gsstream.api import InputError


def total(count: int) -> int:
    return count * (count - 1) // 2


@pytest.mark.parametrize("threads", [1, 2, 3, 8])
@pytest.mark.parametrize("nested", [False, True])
def test_every_index_is_visited_once(threads: int, nested: bool) -> None:
    set_num_threads(threads)
    for count in (*range(20), 1000, 4099):
        for grain in (1, 3, 64, 5000):
            assert _native.pool_exercise(count, grain, nested) == total(count)


def test_an_exception_reaches_the_caller_and_the_pool_lives_on() -> None:
    set_num_threads(4)
    for where in (0, 17, 999):
        for nested in (False, True):
            with pytest.raises(RuntimeError, match="asked to fail"):
                _native.pool_exercise(1000, 7, nested, where)
            assert _native.pool_exercise(1000, 7, nested) == total(1000)


def test_many_python_threads_and_resizing_at_once() -> None:
    wrong: list[int] = []

    def hammer(seed: int) -> None:
        for i in range(400):
            count = 1 + (37 * i + seed) % 900
            got = _native.pool_exercise(count, 1 + i % 9, i % 3 == 0)
            if got != total(count):
                wrong.append(got)
            if i % 50 == seed:
                set_num_threads(1 + (i // 50 + seed) % 5)

    workers = [threading.Thread(target=hammer, args=(seed,)) for seed in range(4)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join(timeout=60)
    assert not any(worker.is_alive() for worker in workers)
    assert wrong == []


def _in_child(queue: multiprocessing.queues.SimpleQueue[tuple[int, int]]) -> None:
    queue.put((num_threads(), _native.pool_exercise(5000, 1)))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_forked_child_gets_a_pool_of_its_own() -> None:
    set_num_threads(3)
    assert _native.pool_exercise(5000, 1) == total(5000)
    context = multiprocessing.get_context("fork")
    queue = context.SimpleQueue()
    child = context.Process(target=_in_child, args=(queue,))
    child.start()
    child.join(timeout=60)
    assert child.exitcode == 0
    assert queue.get() == (3, total(5000))
    assert _native.pool_exercise(5000, 1) == total(5000)


def run(code: str, threads: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"GSSTREAM_THREADS": threads}
    return subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=60)


def test_environment_sets_the_default_and_nothing_needs_torch() -> None:
    code = (
        "import sys, gsstream_cpu_render.loss, gsstream_cpu_render.threads as t;"
        "print(t.num_threads(), t._native.pool_exercise(100, 1), 'torch' in sys.modules)"
    )
    result = run(code, "5")
    assert result.stdout.split() == ["5", str(total(100)), "False"], result.stderr


@pytest.mark.parametrize("value", ["0", "-3", "two", "4x", "99999999999999999999"])
def test_a_malformed_environment_is_refused(value: str) -> None:
    result = run("import gsstream_cpu_render.threads as t; t.num_threads()", value)
    assert result.returncode != 0
    assert "InputError" in result.stderr
    assert f"got '{value}'" in result.stderr


@pytest.mark.parametrize("n", [0, -1, 1025, 2.0, True])
def test_a_wrong_number_of_threads_is_refused(n: object) -> None:
    with pytest.raises(InputError, match="1 to 1024"):
        set_num_threads(n)  # type: ignore[arg-type]


def test_peaks_are_positive_and_their_arguments_checked() -> None:
    assert fma_peak(1, 0.01) > 0.1
    assert copy_peak(1, 0.1) > 0.1
    for call in (lambda: fma_peak(0, 0.01), lambda: fma_peak(1, 0.0), lambda: copy_peak(1, 0.0)):
        with pytest.raises(InputError, match="expected"):
            call()


#: One tile of 16 x 16 pixels of 4 x 3.
MASK = np.zeros((3, 4), bool)
MASK[1, 2] = True


@pytest.mark.parametrize("incremental", [False, True])
def test_a_masked_kernel_draws_its_tiles_and_no_others(incremental: bool) -> None:
    splats = random_splats(200, 0, 4)
    active = np.arange(0, 200, 3) if incremental else None
    kernels = [
        Kernel(tuple(splats), *camera(), WIDTH, HEIGHT, 0.01, mask, active, upstream(0)[0]) for mask in (None, MASK)
    ]
    (image, *_), (masked, *_) = (kernel.forward() for kernel in kernels)
    pairs, few = (kernel.statistics()["pairs"] for kernel in kernels)
    assert 0 < few < pairs / 2
    masked = np.array(masked)
    np.testing.assert_array_equal(masked[16:32, 32:48], np.array(image)[16:32, 32:48])
    elsewhere = np.ones((HEIGHT, WIDTH), bool)
    elsewhere[16:32, 32:48] = False
    assert not masked[elsewhere].any(), "black is the background, and nothing else was drawn there"
    assert np.array(image)[elsewhere].any()
