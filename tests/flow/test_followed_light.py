"""Whole runs under light that dims, that jumps, and that stays: what follows it, what it costs, and who is left out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flow_runs import encode, metrics

from gsstream.core.frame import Frame
from gsstream.input.recordings.synthetic import SyntheticSource
from gsstream.packet import StreamReader

WORLD = "synthetic:frames=26&views=4&width=96&height=72&supersample=1&event=1&scene="
FAST: dict[str, Any] = {"first_frame__max_iterations": 120, "first_frame__max_points": 1500, "stream__epochs": 2}


def later_packets(out: Path) -> list[bytes]:
    """All packets but the first, which holds the recipe."""
    with StreamReader(out / "stream.gss") as reader:
        return [reader.read(entry) for entry in reader.frames[1:]]


def two_runs(folder: Path, scene: str, *more: str) -> tuple[Path, Path]:
    """The same recording with colours that follow the light, and with colours that do not; they share frame 0."""
    stays, follows = folder / "stays", folder / "follows"
    encode(stays, *more, source=WORLD + scene, method="s2gs-edge", **FAST, stream__light=0)
    first = ("--first-frame", str(stays / "stream.gss"))
    encode(follows, *more, *first, source=WORLD + scene, method="s2gs-edge", **FAST, stream__light=1)
    return stays, follows


def followed(out: Path) -> list[int]:
    return [line["frame"] for line in metrics(out) if "camera_drift" in line]


def quality(out: Path, frames: slice) -> float:
    return float(np.mean([value for line in metrics(out)[frames] for value in line["psnr"].values()]))


def test_light_that_dims_is_asked_about_every_fifth_frame_and_costs_no_quality(tmp_path: Path) -> None:
    stays, follows = two_runs(tmp_path, "dim")
    assert followed(stays) == []
    assert len(followed(follows)) >= 2
    assert all(frame % 5 == 0 for frame in followed(follows))
    assert quality(follows, slice(16, 26)) > quality(stays, slice(16, 26)) - 0.05


@pytest.mark.parametrize("scene", ["paths", "flash", "lamp"])
def test_no_byte_is_sent_for_light_that_stays_or_jumps(tmp_path: Path, scene: str) -> None:
    stays, follows = two_runs(tmp_path, scene)
    assert followed(follows) == []
    assert later_packets(follows) == later_packets(stays)


def test_light_is_followed_within_a_budget_of_bytes_or_not_at_all(tmp_path: Path) -> None:
    _, follows = two_runs(tmp_path, "dim", "--budget", "size=1200B")
    assert followed(follows)
    assert max(map(len, later_packets(follows))) <= 1200


def test_light_falls_on_a_scene_in_which_nothing_moves(tmp_path: Path) -> None:
    _, follows = two_runs(tmp_path, "dim&static=1")
    assert quality(follows, slice(20, 26)) > quality(follows, slice(0, 1)) - 1.5


def test_a_camera_that_drifts_alone_does_not_drag_the_colours_along(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The room dims for all, and one camera of four dims as much again; what is reported of it is its own part."""
    image = SyntheticSource.stored_frame

    def drifting(source: SyntheticSource, index: int, split: Any = "train") -> Frame:
        frame = image(source, index, split)
        if split == "train":
            frame.images[2] = np.rint(frame.images[2] * (1 - 0.0025 * index)).astype(frame.images.dtype)
        return frame

    monkeypatch.setattr(SyntheticSource, "stored_frame", drifting)
    _, follows = two_runs(tmp_path, "dim")
    drift = metrics(follows)[followed(follows)[-1]]["camera_drift"]
    assert int(np.argmin(drift)) == 2
    others = np.delete(drift, 2)
    assert drift[2] < others.min() - 1
    assert abs(sum(drift)) < 0.1
