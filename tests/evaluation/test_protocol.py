"""Published protocols: what does not fit is refused, and what they report is a mean anybody can make again."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gsstream.cli.main import run_command
from gsstream.core.cameras import Cameras
from gsstream.core.errors import InputError, UnknownName
from gsstream.evaluation.evaluate import Evaluation, ViewQuality
from gsstream.evaluation.protocol import PROTOCOLS, EvaluationProtocol, check_protocol, protocol_numbers
from gsstream.input.recordings.base import SourceInfo


def rig(ids: tuple[str, ...], width: int, height: int) -> Cameras:
    n = len(ids)
    return Cameras(ids, np.tile(np.eye(4), (n, 1, 1)), np.tile(np.diag([50.0, 50.0, 1.0]), (n, 1, 1)), width, height)


def recording(
    name: str, size: tuple[int, int] | None = None, test: tuple[str, ...] | None = None, train: int | None = None
) -> SourceInfo:
    """What fits a protocol, but for what is given."""
    known = PROTOCOLS[name]
    width, height = size or (known.width, known.height)
    training = tuple(f"t{i}" for i in range(train or known.train or 17))
    cameras = [rig(ids, width, height) for ids in (training, test or known.test)]
    return SourceInfo("made up", "made:up", known.frames, 30.0, *cameras)


@pytest.mark.parametrize("name", PROTOCOLS)
def test_what_fits_is_admitted_in_whatever_order_cameras_come(name: str) -> None:
    check_protocol(name, recording(name), "none", [0, 1])
    check_protocol(name, recording(name, test=PROTOCOLS[name].test[::-1]), "none", [0, 1])


def test_the_layout_of_the_data_set_names_the_same_cameras_without_leading_zeros() -> None:
    test = ("cam0", "cam10", "cam15", "cam30")  # as panoptic:DIR names them
    check_protocol("panoptic-sports", recording("panoptic-sports", test=test), "none", [0, 1])
    with pytest.raises(InputError, match="got cam1, cam10, cam15, cam30"):
        check_protocol("panoptic-sports", recording("panoptic-sports", test=("cam1", *test[1:])), "none", [0, 1])


@pytest.mark.parametrize("name", PROTOCOLS)
@pytest.mark.parametrize(
    ("other", "leak", "what"),
    [
        ({"size": (320, 180)}, "none", "pictures: expected {width} x {height}, got 320 x 180"),
        ({"test": ("cam99",)}, "none", "test cameras: expected {cameras}, got cam99"),
        ({}, "training", "data.leak: expected none, got training"),
        ({}, "points", "data.leak: expected none, got points"),
    ],
)
def test_what_does_not_fit_is_refused(name: str, other: Mapping[str, Any], leak: str, what: str) -> None:
    known = PROTOCOLS[name]
    expected = what.format(width=known.width, height=known.height, cameras=", ".join(known.test))
    with pytest.raises(InputError) as caught:
        check_protocol(name, recording(name, **other), leak, [0, 1])
    assert f"--protocol {name}: {expected}; run with" in str(caught.value)


def test_fewer_training_cameras_are_refused_where_their_number_is_known() -> None:
    with pytest.raises(InputError, match="training cameras: expected 27, got 8"):
        check_protocol("panoptic-sports", recording("panoptic-sports", train=8), "none", [0, 1])
    check_protocol("n3dv", recording("n3dv", train=20), "none", [0, 1])


def quality(frame: int, camera: str, psnr: float) -> ViewQuality:
    return ViewQuality(frame, camera, psnr, psnr / 100, psnr, 1.0, 0.0, 0.0, 0.0)


def test_the_first_frame_counts_and_gaps_are_refused() -> None:
    views = [quality(t, camera, 20.0 + t + 4 * (camera == "b")) for t in range(3) for camera in "ab"]
    found = protocol_numbers("n3dv", Evaluation(tuple(views), {}, "r"))
    assert (found["psnr"], found["ssim"], found["frames"], found["of_frames"]) == (23, pytest.approx(0.23), 3, 300)
    for frames in ((1, 2), (0, 2), tuple(range(301))):
        with pytest.raises(InputError, match=r"expected 0 to at most 299, got .*; say --frames 0:300"):
            check_protocol("n3dv", recording("n3dv"), "none", frames)


def test_a_name_that_is_almost_right_is_corrected() -> None:
    with pytest.raises(UnknownName, match="did you mean 'panoptic-sports'"):
        check_protocol("panoptic-sport", recording("n3dv"), "none", [0, 1])


SOURCE = "synthetic:frames=2&views=4&width=32&height=24&supersample=1"


def test_a_run_and_its_pictures_are_measured_by_the_same_protocol(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    run, pictures = tmp_path / "run", tmp_path / "pictures"
    command = ["run", "--method", "hold", "--source", SOURCE, "--out", str(run), "--quiet", "--no-pictures"]
    small = ("--set", "first_frame.max_iterations=3", "--set", "first_frame.points=recording")
    assert run_command([*command, *small]) == 0
    assert run_command(["evaluate", str(run), "--protocol", "n3dv"]) == 2
    assert "pictures: expected 1352 x 1014, got 32 x 24" in capsys.readouterr().err
    assert run_command(["evaluate", str(run), "--json"]) == 0
    views = json.loads(capsys.readouterr().out)["views"]
    test = tuple(sorted({view["camera"] for view in views}))
    tiny = EvaluationProtocol(32, 24, test, 4, 2, "a test", "run it again")
    monkeypatch.setattr("gsstream.evaluation.protocol.PROTOCOLS", {"tiny": tiny})
    assert run_command(["evaluate", str(run), "--protocol", "tiny", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)["protocol"]
    assert found["psnr"] == pytest.approx(np.mean([view["psnr"] for view in views]))
    assert run_command(["play", str(run), "--camera", "test", "--out", str(pictures)]) == 0
    capsys.readouterr()
    assert run_command(["evaluate-files", "--renders", str(pictures), "--source", SOURCE, "--protocol", "tiny"]) == 0
    assert "protocol tiny of a test: PSNR " in capsys.readouterr().out
