"""Images that wait take the memory of their bits: in every layout, under every split, and as a budget counts them."""

from __future__ import annotations

import json
import tracemalloc
from concurrent.futures import wait
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from tiny_recordings import LAYOUTS, make_world, write_frames

from gsstream.engine.budget.memory import WAITING, waiting_memory
from gsstream.input.recordings.base import Source
from gsstream.input.recordings.canonical import CanonicalSource, recording_similarity
from gsstream.input.recordings.open import open_source
from gsstream.input.recordings.options import DataOptions
from gsstream.input.recordings.prefetch import Prefetcher
from gsstream.input.recordings.transformed import transformed

CAMERAS, SIZE = 27, (192, 144)
LENS = {"distortion": [-0.05, 0.01, 0.0, 0.0]}


def as_runs_open_it(uri: str, scale: float = 1.0, **options: Any) -> Source:
    source = open_source(uri, scale)
    return CanonicalSource(transformed(source, DataOptions(**options)), recording_similarity(source))


@pytest.mark.parametrize("name", LAYOUTS)
def test_pictures_of_8_bits_wait_as_bytes_in_every_layout_under_every_split(tmp_path: Path, name: str) -> None:
    if name in ("n3dv", "meetroom", "colmap text", "nerfstudio videos"):
        pytest.importorskip("av")
    folder = LAYOUTS[name].write(tmp_path / "scene", make_world(frames=1))
    ids = open_source(str(folder)).info.train.ids
    for options in ({}, {"test_cameras": ids[:1]}, {"split": "tuning"}, {"train_views": 2}, {"bad_image": "repeat"}):
        source = as_runs_open_it(str(folder), **options)
        assert source.stores_bytes
        with Prefetcher(source, [0], pack=True) as frames:
            pair = next(frames)
        for frame, split in zip(pair, ("train", "test"), strict=True):
            assert frame.images.dtype == np.uint8
            assert np.array_equal(frame.as_float32().images, source.frame(0, split).images)


def write_rig(folder: Path, frames: int, deep: bool = False, **more: Any) -> Path:
    """Cameras in a row, all training cameras, with pictures of noise; ``more`` is said of each of them."""
    rng, cameras = np.random.default_rng(0), []
    for number in range(CAMERAS):
        pose = np.eye(4)
        pose[0, 3] = -0.1 * number
        K = [[150.0, 0, SIZE[0] / 2], [0, 150.0, SIZE[1] / 2], [0, 0, 1]]
        name = f"cam{number:02d}"
        cameras.append({"id": name, "width": SIZE[0], "height": SIZE[1], "K": K, "w2c": pose.tolist(), **more})
        cameras[-1]["frames"] = f"{name}/%04d.png"
        shape = (frames, SIZE[1], SIZE[0], 3)
        if deep:
            (folder / name).mkdir(parents=True)
            for t, picture in enumerate(rng.integers(0, 1 << 16, shape[:3]).astype(np.uint16)):
                Image.fromarray(picture).save(folder / name / f"{t:04d}.png")
        else:
            write_frames(folder / name, rng.integers(0, 256, shape, dtype=np.uint8))
    (folder / "cameras.json").write_text(json.dumps({"frames": frames, "cameras": cameras}))
    return folder


@pytest.mark.parametrize(("lens", "images"), [({}, 8), (LENS, 16)], ids=["pinhole", "lens"])
def test_reading_a_frame_with_one_camera_held_out_takes_3_bytes_per_pixel(
    tmp_path: Path, lens: dict[str, Any], images: int
) -> None:
    """27 cameras; beside them there is room for a few images of one camera as float32."""
    source = as_runs_open_it(str(write_rig(tmp_path / "rig", 1, **lens)), test_cameras=("cam13",))
    source.stored_frame(0)  # what is imported and made once
    pixels = CAMERAS * SIZE[0] * SIZE[1]
    tracemalloc.start()
    try:
        with Prefetcher(source, [0], pack=True) as frames:
            pair = next(frames)
        kept, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert sum(frame.images.nbytes for frame in pair) == 3 * pixels
    assert kept / pixels == pytest.approx(3, rel=0.05)
    assert most / pixels < 3 + 12 * images / CAMERAS


@pytest.mark.parametrize(
    ("rig", "scale", "size"),
    [({}, 1.0, 3), ({}, 0.5, 12), (LENS, 1.0, 3), (LENS, 0.5, 12), ({"deep": True}, 1.0, 12)],
    ids=["as stored", "scaled", "lens", "scaled lens", "16 bits"],
)
@pytest.mark.parametrize("options", [{}, {"train_views": 9}], ids=["all", "nine"])
def test_a_budget_of_memory_counts_what_waits(
    tmp_path: Path, rig: dict[str, Any], scale: float, size: int, options: dict[str, Any]
) -> None:
    """The frame in work, the one before and two that are read ahead, as a run holds them."""
    source = as_runs_open_it(str(write_rig(tmp_path / "rig", WAITING, **rig)), scale, **options)
    source.stored_frame(0)
    tracemalloc.start()
    try:
        with Prefetcher(source, range(WAITING), depth=2, pack=True) as frames:
            held = [next(frames), next(frames)]
            wait(frames._pending)
            waits, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert len(held) == WAITING - 2
    counted = waiting_memory(source)
    assert counted == WAITING * size * len(source.info.train) * source.info.train.width * source.info.train.height
    assert waits == pytest.approx(counted, rel=0.1)
