"""Runs under ``data.*``, on disturbed recordings, and of what once failed in the soak job."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from early_densify import densifying
from flow_runs import Witness, arguments, encode, metrics

from gsstream.cli.main import run_command
from gsstream.core import frame as core_frame
from gsstream.input.recordings.canonical import CanonicalSource
from gsstream.input.recordings.open import open_source
from gsstream.player.playback import Playback

TINY_WORLD = "synthetic:frames=3&views=3&width=16&height=12&supersample=1"


@pytest.mark.parametrize("method", ["dense", "queen-published"])
def test_the_reference_renderer_can_grow_a_scene(tmp_path: Path, method: str) -> None:
    """Densification asks a session for the gradient of the 2-D means."""
    # In pictures this small, pruning leaves nothing of the scene itself.
    behind = {"first_frame__shell": True, "background": "auto"}
    settings: dict[str, Any] = {"first_frame__max_iterations": 20, "stream__epochs": 4, **behind}
    with densifying(4, 4, 1e-6):
        encode(tmp_path, "--set", "renderer=reference", source=TINY_WORLD, method=method, **settings)
    assert [line["status"] for line in metrics(tmp_path)] == ["key", "delta", "delta"]


@pytest.mark.parametrize("method", ["s2gs-edge", "queen"])
def test_images_as_bytes_lose_nothing_of_8_bits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, method: str) -> None:
    """At full size the recording has 8 bits: every frame decodes to the same scene."""
    witness = Witness(monkeypatch)
    scenes = []
    for waiting in ("float32", "bytes"):
        with monkeypatch.context() as patch:
            if waiting == "float32":
                patch.setattr(CanonicalSource, "stored_frame", CanonicalSource.frame)
                patch.setattr(core_frame, "packed", lambda images: images)
            encode(tmp_path / waiting, "--frames", "4", method=method)
        with Playback(tmp_path / waiting / "stream.gss") as playback:
            scenes.append([playback.state_at(frame).means.tobytes() for frame in playback.frames])
    assert scenes[0] == scenes[1]
    assert len(set(scenes[0])) > 1
    if method == "s2gs-edge":
        assert witness.states[-1].previous.images.dtype == np.uint8


DISTURBED = "disturbed:gain_amplitude=0.3,noise_sigma=8,lost_share=0.4,time_offset={}@1"


def test_a_disturbed_run_is_evaluated_on_what_it_saw(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    world = "synthetic:frames=5&views=3&width=64&height=48&supersample=1"
    name = open_source(world).info.test.ids[0]
    source = f"{DISTURBED.format(name)}:{world}"
    encode(tmp_path / "whole", source=source, method="s2gs-edge", data__train_views=2)
    assert len(metrics(tmp_path / "whole")) == 4  # the offset costs one frame
    capsys.readouterr()
    assert run_command(["evaluate", str(tmp_path / "whole")]) == 2, "a source of a plugin is opened when it is named"
    assert "name it yourself with --source" in capsys.readouterr().err
    assert run_command(["evaluate", str(tmp_path / "whole"), "--source", source]) == 0
    mean = sum(next(iter(line["psnr"].values())) for line in metrics(tmp_path / "whole")[1:]) / 3
    assert f"{mean:.2f}" in capsys.readouterr().out


LEAKING: dict[str, Any] = {
    "source": "synthetic:frames=2&views=3&width=32&height=24&supersample=1",
    "first_frame__points": "sweep",
    "stream__epochs": 1,
}


@pytest.fixture(scope="module")
def honest(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    return encode(tmp_path_factory.mktemp("honest"), **LEAKING)


@pytest.mark.parametrize("leak", ["points", "training"])
def test_leaks_change_the_stream_only_when_asked_for(tmp_path: Path, honest: bytes, leak: str) -> None:
    assert encode(tmp_path, data__leak=leak, **LEAKING) != honest


def test_the_tuning_split_knows_nothing_of_the_test_camera(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Not a byte of a run in the tuning split depends on what the test camera sees."""
    world = "synthetic:frames=2&views=4&width=64&height=48&supersample=1"
    (test_camera,) = open_source(world).info.test.ids
    encode(tmp_path / "o", source=world, stream__epochs=1, data__split="tuning")
    with Playback(tmp_path / "o" / "stream.gss") as playback:
        meta = playback.meta
    assert test_camera not in (*meta.train.ids, *meta.test.ids)
    assert f"test cameras: {meta.test.ids[0]} (tuning split" in (tmp_path / "o" / "summary.txt").read_text()
    assert list(metrics(tmp_path / "o")[1]["psnr"]) == list(meta.test.ids)
    # A frame 0 that has seen the test camera is refused, and one whose colour maps are of other cameras.
    encode(tmp_path / "all", "--frames", "1", source=world, first_frame__exposure="true")
    capsys.readouterr()
    for change, message in (("split=tuning", "test cameras here"), ("train_views=3", "has colour maps of")):
        take = ("--first-frame", str(tmp_path / "all"), "--overwrite", "--set", f"data.{change}")
        command = arguments(tmp_path / "no", *take, source=world)
        assert run_command(command) == 2
        assert message in capsys.readouterr().err


def test_a_camera_that_is_not_there_ends_with_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(arguments(tmp_path / "o", "--set", 'data.train_cameras=["cam9"]')) == 2
    assert "data.train_cameras: no camera 'cam9'" in capsys.readouterr().err
    assert not (tmp_path / "o" / "stream.gss").exists()
