"""Runs whose recipe leaves values to the scene: what they used is in the stream, and they go on with exactly that."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from flow_runs import WORLD, arguments, broken_off_in, demo_copy, encode, metrics
from PIL import Image, ImageOps

from gsstream.cli.main import run_command
from gsstream.engine.auto import trials
from gsstream.engine.run import encoder
from gsstream.packet import StreamReader, decode_packet
from gsstream.recipe.load import load_recipe

AUTO = {"structure__root_exponent": "auto", "structure__log_base": "auto", "first_frame__sh_degree": "auto"}
SIX = "synthetic:frames=2&views=6&width=64&height=48&supersample=1"
BRIEF: dict[str, Any] = {"first_frame__trials": 6, "first_frame__trial_epochs": 1}
KEYS = {"structure.params.root_exponent", "structure.params.log_base", "first_frame.sh_degree"}


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An undisturbed run of six frames with a later key packet."""
    out = tmp_path_factory.mktemp("auto")
    encode(out, method="s2gs-edge", codec__key_every=4, **AUTO)
    return out


def key_packet(out: Path, frame: int = 0) -> Any:
    with StreamReader(out / "stream.gss") as reader:
        return decode_packet(None, reader.read(reader.frames[frame])).meta


def test_a_run_says_what_it_used(whole: Path) -> None:
    said = metrics(whole)[0]["auto"]
    assert set(said) == KEYS
    assert all(entry["why"] for entry in said.values())
    assert "auto" not in metrics(whole)[1]
    recipe = load_recipe(whole / "recipe.yaml").recipe
    for meta in (key_packet(whole), key_packet(whole, 4)):
        assert dict(meta.extra["auto"]) == said
        assert meta.recipe == json.loads(recipe.model_dump_json())
    assert recipe.structure.params["root_exponent"] == said["structure.params.root_exponent"]["value"]
    assert recipe.first_frame.sh_degree == said["first_frame.sh_degree"]["value"]


def test_a_run_with_the_chosen_values_makes_the_same_scene(tmp_path: Path, whole: Path) -> None:
    said = metrics(whole)[0]["auto"]
    values = {key.replace(".params", "").replace(".", "__"): entry["value"] for key, entry in said.items()}
    encode(tmp_path, method="s2gs-edge", codec__key_every=4, **values)
    with StreamReader(tmp_path / "stream.gss") as one, StreamReader(whole / "stream.gss") as other:
        deltas = [(one.read(a), other.read(b)) for a, b in zip(one.frames, other.frames, strict=True)]
    assert [a == b for a, b in deltas] == [frame not in (0, 4) for frame in range(6)]  # key packets say why


@pytest.mark.parametrize("saved", [False, True], ids=["auto", "saved recipe"])
def test_resume_takes_the_values_from_the_stream(
    tmp_path: Path, whole: Path, monkeypatch: pytest.MonkeyPatch, saved: bool
) -> None:
    """Bit-exact, and nothing is measured again; with the recipe that says auto, or with the one that was saved."""

    def never(*_: object) -> None:
        raise AssertionError("a resumed run measures the scene again")

    command = arguments(tmp_path / "o", method="s2gs-edge", codec__key_every=4, **AUTO)
    with broken_off_in(3):
        assert run_command(command) == 130
    monkeypatch.setattr(encoder, "choose", never)
    if saved:
        recipe = (tmp_path / "o" / "recipe.yaml").rename(tmp_path / "recipe.yaml")
        command = ["run", "--source", WORLD, "--recipe", str(recipe), "--out", str(tmp_path / "o"), "--no-pictures"]
    assert run_command([*command, "--resume"]) == 0
    assert (tmp_path / "o" / "stream.gss").read_bytes() == (whole / "stream.gss").read_bytes()


def test_resume_of_a_stream_with_given_values_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    encode(tmp_path, "--frames", "1", method="s2gs-edge", structure__root_exponent=4)
    command = arguments(tmp_path, "--resume", method="s2gs-edge", structure__root_exponent="auto")
    assert run_command(command) == 2
    assert "'auto' for structure.params.root_exponent" in capsys.readouterr().err


def test_a_frame_0_that_is_taken_over_brings_its_choices(
    tmp_path: Path, whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken = ("--first-frame", str(whole / "stream.gss"), "--frames", "2")
    for name in ("scene_facts", "try_out"):
        monkeypatch.setattr(trials, name, None)
    encode(tmp_path / "same", *taken, method="s2gs-edge", **AUTO)
    assert metrics(tmp_path / "same")[0]["auto"] == metrics(whole)[0]["auto"]


def test_a_frame_0_with_given_values_brings_its_degree(tmp_path: Path) -> None:
    encode(tmp_path / "given", "--frames", "1", method="s2gs-edge", first_frame__sh_degree=1)
    taken = ("--first-frame", str(tmp_path / "given" / "stream.gss"), "--frames", "2")
    encode(tmp_path / "taken", *taken, method="s2gs-edge", **AUTO)
    said = metrics(tmp_path / "taken")[0]["auto"]
    assert said["first_frame.sh_degree"]["value"] == 1
    assert set(said) == KEYS


@pytest.fixture(scope="module")
def tried(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose training cameras are enough to leave some out."""
    out = tmp_path_factory.mktemp("tried")
    encode(out, source=SIX, method="s2gs-edge", **BRIEF, **AUTO)
    return out


def test_a_run_tries_choices_out(tried: Path) -> None:
    recorded = metrics(tried)[0]["auto"]
    made = {re.match(r"best of (\d+) trials \(\d+\.\d\d dB", entry["why"]).group(1) for entry in recorded.values()}
    assert len(made) == 1
    assert 3 <= int(made.pop()) <= BRIEF["first_frame__trials"]
    assert dict(key_packet(tried).extra["auto"]) == recorded


def test_trials_leave_no_trace_but_the_values(tmp_path: Path, tried: Path) -> None:
    recorded = metrics(tried)[0]["auto"]
    values = {key.replace(".params", "").replace(".", "__"): entry["value"] for key, entry in recorded.items()}
    encode(tmp_path, source=SIX, method="s2gs-edge", **BRIEF, **values)
    with StreamReader(tmp_path / "stream.gss") as one, StreamReader(tried / "stream.gss") as other:
        assert one.read(one.frames[1]) == other.read(other.frames[1])
        first, second = (decode_packet(None, r.read(r.frames[0])) for r in (one, other))
    for name, ours in first.gaussians.items():
        assert ours.tobytes() == dict(second.gaussians.items())[name].tobytes(), name


def invert_test_images(folder: Path) -> None:
    """Make the test cameras of a copy of the demo see everything inverted."""
    cameras = json.loads((folder / "cameras.json").read_text())["cameras"]
    for camera in cameras:
        if camera["split"] == "test":
            for path in (folder / camera["id"]).glob("*.jpg"):
                ImageOps.invert(Image.open(path).convert("RGB")).save(path, quality=95)


def test_test_cameras_have_no_say(tmp_path: Path) -> None:
    """Whatever they recorded, trials find the same, to the last decibel that they print."""
    said = []
    for name in ("as recorded", "inverted"):
        folder = demo_copy(tmp_path / name, train=5, frames=1)
        if name == "inverted":
            invert_test_images(folder)
        settings = {**BRIEF, "scale": 0.25, "first_frame__points": "sweep", **AUTO}
        encode(tmp_path / f"{name}-run", source=str(folder), method="s2gs-edge", **settings)
        said.append(metrics(tmp_path / f"{name}-run")[0])
    assert said[0]["psnr"] != said[1]["psnr"], "the test camera saw something else"
    assert said[0]["auto"] == said[1]["auto"]
    assert all(entry["why"].startswith("best of ") for entry in said[0]["auto"].values())
