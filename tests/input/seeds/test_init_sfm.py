"""Triangulation with known poses, in a process of its own."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from gsstream.core.errors import InputError
from gsstream.input.recordings.primitives import cast
from gsstream.input.recordings.synthetic import SyntheticSource
from gsstream.input.seeds import sfm

needs_pycolmap = pytest.mark.skipif(importlib.util.find_spec("pycolmap") is None, reason="pycolmap is not installed")


@pytest.mark.sfm
@needs_pycolmap
def test_points_lie_on_the_true_surfaces_and_repeat() -> None:
    source = SyntheticSource.from_query("width=320&height=240&views=8")
    images, cameras = source.frame(0).images, source.info.train
    points = sfm.triangulate_points(images, cameras)
    assert len(points) > 80
    shapes = source._static + source._scene.moving(0)
    error = np.full(len(points), np.inf)
    for center in cameras.centers:
        hits = cast(center, (points.xyz - center).astype(np.float32), shapes)
        error = np.minimum(error, np.abs(hits.distance - 1))
    assert np.median(error) < 0.005
    assert (error < 0.03).mean() > 0.9
    assert 0 < points.rgb.mean() < 1
    assert sfm.triangulate_points(images, cameras).xyz.tobytes() == points.xyz.tobytes()


@pytest.mark.sfm
@needs_pycolmap
def test_images_without_features_are_explained() -> None:
    source = SyntheticSource.from_query("width=64&height=48&views=3")
    with pytest.raises(InputError, match="found no points in 3 training images of 64 x 48"):
        sfm.triangulate_points(np.full((3, 48, 64, 3), 0.5, np.float32), source.info.train)


@pytest.mark.sfm
@needs_pycolmap
def test_the_adapter_leaves_compression_intact(tmp_path: Path) -> None:
    # In a fresh process: loaded in the wrong order, pycolmap's own zlib corrupts the heap at the next compression.
    code = (
        "import gsstream.input.seeds._pycolmap, zlib, sys\n"
        "data = bytes(range(256)) * 4096\n"
        "assert zlib.decompress(zlib.compress(data, 9)) == data\n"
        "import numpy as np\n"
        "a = np.random.default_rng(0).integers(0, 9, 200000)\n"
        "np.savez_compressed(sys.argv[1], a=a)\n"
        "assert (np.load(sys.argv[1])['a'] == a).all()\n"
        "print('intact')\n"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "a.npz")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout.strip()) == (0, "intact"), done.stderr


def test_a_native_abort_becomes_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # A stand-in interpreter that aborts, as the library does on faults it cannot report.
    aborting = tmp_path / "python"
    aborting.write_text("#!/bin/sh\necho 'free(): invalid pointer' >&2\nkill -ABRT $$\n")
    aborting.chmod(0o755)
    monkeypatch.setattr(sys, "executable", os.fspath(aborting))
    with pytest.raises(InputError, match=r"was ended by signal 6: .*free\(\): invalid pointer"):
        sfm.run_pycolmap("triangulate", tmp_path, 30)


def test_a_missing_library_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    source = SyntheticSource.from_query("width=16&height=16&views=3")
    with pytest.raises(InputError, match=r"pip install 'gsstream\[sfm\]'"):
        sfm.triangulate_points(source.frame(0).images, source.info.train)


@pytest.mark.sfm
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system does not choose processors")
def test_the_number_of_processors_changes_no_bit() -> None:
    """Images of different sizes of work finish in another order than they began; the database must not show it."""
    pytest.importorskip("pycolmap")
    from gsstream.input.recordings.open import open_source
    from gsstream.input.seeds.mapping import reconstruct

    images = open_source("synthetic:width=240&height=180&views=5&frames=1&static=true").frame(0).images
    large = [np.kron(images[0], np.ones((3, 3, 1), np.float32)), *images[1:]]  # the first takes longest
    before, found = os.sched_getaffinity(0), []
    try:
        for cores in (before, {min(before)}, before):
            os.sched_setaffinity(0, cores)
            found.append(reconstruct(large, model="PINHOLE", shared=False))
    finally:
        os.sched_setaffinity(0, before)
    for other in found[1:]:
        assert other.xyz.tobytes() == found[0].xyz.tobytes()
        assert other.viewmats.tobytes() == found[0].viewmats.tobytes()
    assert len(found[0].xyz) > 5
