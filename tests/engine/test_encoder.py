"""Encoder: in memory it makes the packets of a run on disk; failing and resuming cost no packet a bit."""

from __future__ import annotations

import subprocess
import sys
import warnings
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from bundle import Bundle
from early_densify import densifying
from growing_plugin import growth_installed

import gsstream
from gsstream.cli.main import run_command
from gsstream.core.errors import ComponentError, InputError, RecipeError, ShapeError
from gsstream.core.frame import Frame
from gsstream.encode import Callbacks, Cameras, Encoder, encoder_for, encoder_for_rig, open_recording
from gsstream.engine.frame0.begin import decoded_anchors
from gsstream.engine.keys.resume import rebuild_hierarchy
from gsstream.engine.run.encoder import EncodedFrame
from gsstream.packet import PacketKind, StreamReader, StreamWriter, decode_packet
from gsstream.play import Playback

#: A body that moves two pixels a frame: motions have something to say.
WORLD = "synthetic:frames=6&views=3&width=32&height=24&supersample=1"
TINY: Mapping[str, Any] = {
    "first_frame.max_iterations": 40,
    "first_frame.points": "recording",
    "first_frame.max_points": 250,
    "stream.epochs": 1,
    # Images this small and this far off would not miss most of what the cases need.
    "first_frame.prune_error": 0,
}
GROWING: Mapping[str, Any] = {"growth": "neighbours", "growth.per_frame": 24}
#: Gaussians are added and pruned in the first two of the three frames, so that all that goes on has to go on exactly.
REFINING: Mapping[str, Any] = {
    "stream.refine_frames": 3,
    "stream.refine_iterations": 6,
}
#: Pictures this small hardly say where a group has gone: what holds it back must be weak.
MOVING: Mapping[str, Any] = {"motion": "rigid", "motion.epochs": 1, "motion.hold": 0.1}
CASES: Mapping[str, Mapping[str, Any]] = {
    "still": {"motion": "still"},
    "rigid": {**MOVING},
    "keys": {**MOVING, "codec.key_interval": 2},
    "growing": {**GROWING, **MOVING},
    "growing rigid with keys": {**GROWING, **MOVING, "codec.key_interval": 3},
    "refined": {**REFINING, **MOVING},
    "growing refined with keys": {**GROWING, **REFINING, **MOVING, "codec.key_interval": 2},
}


@pytest.fixture(autouse=True, scope="module")
def growth(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    with growth_installed(tmp_path_factory.mktemp("growth")):
        yield


def early(case: str) -> AbstractContextManager[None]:
    """A refinement has few iterations: in its cases Gaussians are added early."""
    return densifying(5, 4) if "refined" in case else nullcontext()


@pytest.fixture(autouse=True)
def early_in_its_case(request: pytest.FixtureRequest) -> Iterator[None]:
    with early(getattr(request.node, "callspec", SimpleNamespace(params={})).params.get("case", "")):
        yield


@cache
def frames(uri: str = WORLD) -> tuple[Frame, ...]:
    with open_recording(uri) as source:
        return tuple(source.frame(index) for index in range(source.info.num_frames or 0))


def encoder(case: str = "still", listeners: Callbacks | None = None) -> Encoder:
    with open_recording(WORLD) as source:
        return encoder_for("s2gs-edge", source, {**TINY, **CASES[case]}, listeners)


@cache
def whole(case: str) -> tuple[EncodedFrame, ...]:
    """The steps of an undisturbed encoder."""
    made = encoder(case)
    with early(case):
        return tuple(made.encode(frame) for frame in frames())


def packets(steps: tuple[EncodedFrame, ...] | list[EncodedFrame]) -> list[bytes]:
    return [step.packet.data for step in steps]


def write(path: Path, steps: tuple[EncodedFrame, ...]) -> Path:
    with StreamWriter.open(path) as writer:
        for step in steps:
            writer.append(step.packet)
    return path


def same_bits(ours: Any, theirs: Any) -> None:
    for (name, a), (_, b) in zip(ours.items(), theirs.items(), strict=True):
        assert a.tobytes() == b.tobytes(), name


@pytest.mark.parametrize("case", ["still", "growing rigid with keys"])
def test_it_makes_the_packets_of_a_run_on_disk(tmp_path: Path, case: str) -> None:
    sets = [item for key, value in {**TINY, **CASES[case]}.items() for item in ("--set", f"{key}={value}")]
    run = ["run", "--source", WORLD, "--method", "s2gs-edge", "--out", str(tmp_path / "o"), "--quiet", "--no-pictures"]
    assert run_command([*run, *sets]) == 0
    with StreamReader(tmp_path / "o" / "stream.gss") as reader:
        assert [reader.read(entry) for entry in reader.frames] == packets(whole(case))


def test_the_cases_are_what_they_say() -> None:
    """A case in which nothing moves or nobody is added would prove nothing about it."""
    for case, settings in CASES.items():
        later = [step.metrics for step in whole(case)[1:]]
        kinds = [step.status for step in whole(case)]
        assert any(line["moving_groups"] > 0 for line in later) == (settings["motion"] != "still"), case
        assert any(line["added_gaussians"] > 0 for line in later) == ("growth" in settings), case
        # The refined first frame comes first, periods of key packets after it.
        every, refined = settings.get("codec.key_interval", 6), settings.get("stream.refine_frames")
        due = range(0, 6, every) if refined is None else {0, *range(refined, 6, every)}
        assert [frame for frame, kind in enumerate(kinds) if kind == "key"] == sorted(due), case
        reasons = [line["key_reason"] for line in later if "key_reason" in line]
        assert reasons == ["period" if refined is None else "refined", *["period"] * 5][: len(due) - 1], case
        made = sum(line.get("refine_iterations", 0) for line in later)
        assert made == settings.get("stream.refine_iterations", 0) * (refined or 0), case
        assert refined is None or later[2]["num_gaussians"] != later[1]["num_gaussians"], case


@pytest.mark.parametrize("wrong", [0, 1, 3, 5])
def test_frames_out_of_order_are_refused_and_cost_nothing(wrong: int) -> None:
    made = encoder()
    for frame in frames()[:2]:
        made.encode(frame)
    before = made.state
    with pytest.raises(InputError, match=f"frame {wrong}: expected frame 2, frames are encoded in order"):
        made.encode(frames()[wrong])
    assert made.state is before
    assert made.encode(frames()[2]).packet.data == packets(whole("still"))[2]


def test_images_that_do_not_fit_are_refused_and_cost_nothing() -> None:
    made, second = encoder(), frames()[1]
    made.encode(frames()[0])
    before = made.state
    with pytest.raises(ShapeError):
        made.encode(replace(second, images=second.images[:, :-1]))
    with pytest.raises(ShapeError):
        made.encode(replace(second, images=np.full_like(second.images, 2.0)))
    assert made.state is before
    assert made.encode(second).packet.data == packets(whole("still"))[1]


def test_a_scene_taken_over_is_grouped_as_players_have_it() -> None:
    """A delta leaves positions between those a key packet can say; a resumed run sees only what the packet says."""
    player, apart = whole("still")[-1].state.player, 0
    for seed in range(12):
        shift = np.random.default_rng(seed).normal(0, 0.05, player.gaussians.means.shape).astype(np.float32)
        moved = replace(player.gaussians, means=player.gaussians.means + shift)
        with open_recording(WORLD) as source:
            parts = encoder().assembly
            first = replace(player, scene=replace(player.scene, gaussians=moved))
            state = Encoder(parts, source.info, first_frame=first).encode(frames()[0]).state
        again = rebuild_hierarchy(parts, state.player)
        assert state.hierarchy.node_of.tolist() == again.node_of.tolist(), seed
        given = parts.structure.build(moved.map(torch.from_numpy), decoded_anchors(state.player))
        apart += given.num_nodes != again.num_nodes
    assert apart, "the positions that were given are grouped otherwise: else this proves nothing"


def test_a_rate_is_a_size_of_every_packet() -> None:
    """30 kbit/s at 30 frames a second are 125 bytes a frame, which bind here."""
    with open_recording(WORLD) as source:
        assert source.info.fps == 30
        made = [
            encoder_for("s2gs-edge", source, {**TINY, **limit})
            for limit in ({"budget.rate": "30kbit/s"}, {"budget.size": 125}, {})
        ]
        with pytest.raises(RecipeError, match=r"16 bytes|at least 3.8 kbit/s"):
            encoder_for("s2gs-edge", source, {"budget.rate": "1kbit/s"})
    rated, sized, free = ([one.encode(frame).packet.data for frame in frames()[:4]][1:] for one in made)
    assert rated == sized
    assert max(map(len, rated)) <= 125 < max(map(len, free))


class BrokenGrowth:
    """Stands for a growth part that fails after everything else of the frame has worked; or for a loss."""

    def propose(self, *_: Any) -> None:
        raise RuntimeError("no room")

    prepare = evaluate = propose


@pytest.mark.parametrize("case", list(CASES))
def test_a_frame_that_fails_leaves_the_encoder_as_it_was(case: str) -> None:
    """Its last part fails, after rendering and learning; with that part mended the packets are the undisturbed ones."""
    made, sent = encoder(case), []
    sound = made.assembly
    for frame in frames():
        if frame.index in (1, 4):
            before, player = made.state, made.state.player
            bits = [value.tobytes() for _, value in player.gaussians.items()]
            made.assembly = replace(sound, growth=BrokenGrowth())
            for _ in range(2):
                with pytest.raises(ComponentError, match=f"'BrokenGrowth' .* failed at frame {frame.index}: "):
                    made.encode(frame)
            assert made.state is before
            assert [value.tobytes() for _, value in made.state.player.gaussians.items()] == bits
            made.assembly = sound
        sent.append(made.encode(frame))
    assert packets(sent) == packets(whole(case))


def test_frame_0_that_fails_can_be_made_again() -> None:
    made = encoder()
    sound = made.assembly
    made.assembly = replace(sound, renderer=Bundle(sound.part("renderer"), loss=BrokenGrowth()))
    with pytest.raises(ComponentError) as caught:
        made.encode(frames()[0])
    assert (caught.value.slot, caught.value.frame) == ("renderer.loss", 0)
    assert made.state is None
    made.assembly = sound
    assert made.encode(frames()[0]).packet.data == packets(whole("still"))[0]


@pytest.mark.parametrize("case", list(CASES))
def test_going_on_after_a_frame_equals_never_having_stopped(tmp_path: Path, case: str) -> None:
    stream = write(tmp_path / "stream.gss", whole(case))
    for last in range(5):
        made = encoder(case)
        assert made.resume(stream, lambda index: frames()[index], last) == last
        same_bits(made.state.player.gaussians, whole(case)[last].state.player.gaussians)
        sent = [made.encode(frame) for frame in frames()[last + 1 :]]
        assert packets(sent) == packets(whole(case))[last + 1 :], f"resumed after frame {last}"


@pytest.mark.parametrize("case", ["rigid", "keys"])
def test_going_on_among_skipped_frames_equals_never_having_stopped(tmp_path: Path, case: str) -> None:
    """What moved is looked for where it was heading, which a resumed encoder knows from the packets."""
    given = [replace(frame, epoch_scale=effort) for frame, effort in zip(frames(), (1, 1, 0, 1, 0, 1), strict=True)]
    made = encoder(case)
    unbroken = tuple(made.encode(frame) for frame in given)
    heading = [step.state.player.scene.heading is not None for step in unbroken]
    assert case == "keys" or all(heading[2:4]), "nothing moved: the case asks for a body on its way"
    stream = write(tmp_path / "stream.gss", unbroken)
    for last in range(5):
        made = encoder(case)
        assert made.resume(stream, lambda index: given[index], last) == last
        sent = [made.encode(frame) for frame in given[last + 1 :]]
        assert packets(sent) == packets(unbroken)[last + 1 :], f"resumed after frame {last}"


def test_going_on_asks_for_what_the_scene_shows_and_for_what_its_light_was_compared_with(tmp_path: Path) -> None:
    stream, asked = write(tmp_path / "stream.gss", whole("keys")), list[int]()

    def image(index: int) -> Frame:
        asked.append(index)
        return frames()[index]

    assert encoder("keys").resume(stream, image) == 5
    assert asked == [5, 4, 5]


def test_a_stream_without_a_frame_begins_anew(tmp_path: Path) -> None:
    stream = write(tmp_path / "stream.gss", ())
    made = encoder()
    assert made.resume(stream, lambda index: frames()[index]) is None
    assert made.encode(frames()[0]).packet.data == packets(whole("still"))[0]
    assert encoder().resume(write(tmp_path / "b.gss", whole("still")), lambda index: frames()[index], -1) is None


def test_listeners_are_told_in_order() -> None:
    told: list[tuple[str, Any]] = []
    listeners = Callbacks(
        packet=lambda packet: told.append(("packet", packet.frame)),
        progress=lambda *_: told.append(("progress", None)),
    )
    with open_recording(WORLD) as source:
        made = encoder_for("s2gs-edge", source, TINY, listeners)
    assert told == [], "nothing is done before the first frame"
    steps = [made.encode(frame) for frame in frames()[:3]]
    names = [name for name, _ in told]
    changes = [name for place, name in enumerate(names) if place == 0 or names[place - 1] != name]
    assert changes == ["progress", "packet"]
    assert [frame for name, frame in told if name == "packet"] == [0, 1, 2]
    assert [step.packet.frame for step in steps] == [0, 1, 2]


def test_a_listener_that_fails_is_not_hidden_and_the_frame_can_be_sent_again() -> None:
    refuse = [True]

    def full(packet: Any) -> None:
        if packet.frame == 1 and refuse:
            refuse.clear()
            raise OSError("no space left on device")

    made = encoder("rigid", Callbacks(packet=full))
    made.encode(frames()[0])
    before = made.state
    with pytest.raises(OSError, match="no space left"):
        made.encode(frames()[1])
    assert made.state is before
    sent = [made.encode(frame) for frame in frames()[1:]]
    assert packets(sent) == packets(whole("rigid"))[1:]


def test_a_rig_needs_no_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Images from anywhere: the seeds are swept from them, and the stream plays."""
    rig, settings = frames()[0].cameras, {**TINY, "first_frame.points": "auto", **MOVING}
    made = encoder_for_rig("s2gs-edge", rig, fps=25.0, settings=settings, name="studio")
    steps = tuple(made.encode(frame) for frame in frames()[:3])
    assert steps[0].status == "key"
    with Playback(write(tmp_path / "rig.gss", steps)) as stream:
        assert (stream.meta.source, stream.meta.fps) == ("studio", 25.0)
        assert stream.meta.extra["source_uri"] == "rig:studio"
    assert run_command(["evaluate", str(tmp_path / "rig.gss")]) == 2
    assert "was made from images that Python gave; name a recording" in capsys.readouterr().err
    with Playback(tmp_path / "rig.gss") as stream:
        assert len(stream.cameras("train")) == len(rig)
        assert len(stream.cameras("test")) == 0
        for frame, step in enumerate(steps):
            same_bits(stream.player_state(frame).gaussians, step.state.player.gaussians)
    again = encoder_for_rig("s2gs-edge", rig, fps=25.0, settings=settings, name="studio")
    assert packets([again.encode(frame) for frame in frames()[:3]]) == packets(steps)


@pytest.mark.parametrize(("dtype", "white"), [(np.uint8, 255), (np.float64, 1)])
def test_images_of_other_types_give_the_same_packet_and_lists_are_cameras(dtype: Any, white: int) -> None:
    """Regression: float64 stopped in the middle of frame 0 with a message of torch, uint8 in a loss."""
    first, settings = frames()[0], {**TINY, "first_frame.points": "auto", "first_frame.max_iterations": 2}
    cameras = first.cameras
    listed = Cameras(list(cameras.ids), cameras.viewmats.tolist(), cameras.Ks.tolist(), cameras.width, cameras.height)
    given = np.rint(first.images * 255) if dtype is np.uint8 else first.images
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        step = encoder_for_rig("dense", listed, settings=settings).encode(Frame(5, 0.0, given.astype(dtype), listed))
    wanted = [] if dtype is np.uint8 else [("images of float64 are converted to float32 in [0, 1]", __file__)]
    assert [(str(warning.message), warning.filename) for warning in said] == wanted
    exact = replace(first, index=5, images=(given.astype(np.float32) / np.float32(white)))
    made = encoder_for_rig("dense", cameras, settings=settings)
    assert step.packet.data == made.encode(exact).packet.data
    with pytest.raises(InputError, match="frame 7: expected frame 6"):
        made.encode(replace(exact, index=7))


@pytest.mark.parametrize(
    ("images", "message"),
    [
        (np.zeros((3, 24, 32, 3), np.uint16), "got uint16; divide them by the value that means white"),
        ([[0.0], [0.0, 1.0]], "images: expected an array, or lists of equal lengths"),
    ],
)
def test_images_of_a_type_that_says_no_white_are_refused(images: Any, message: str) -> None:
    with pytest.raises(ShapeError, match=message):
        encoder().encode(replace(frames()[0], images=images))


@pytest.mark.parametrize("name", ["encode", "play", "spec", "testing"])
def test_a_door_shows_what_is_for_its_users(name: str) -> None:
    door = getattr(gsstream, name)
    assert set(dir(door)) == set(door.__all__)
    assert all(hasattr(door, name) for name in door.__all__)


def test_the_package_shows_its_doors_and_opens_them_when_they_are_named() -> None:
    code = (
        "import sys, gsstream; before = 'gsstream.play' in sys.modules; gsstream.play.Playback\n"
        "print(before, 'torch' in sys.modules, 'play' in dir(gsstream), 'importlib' in dir(gsstream))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "False", "True", "False"]
    with pytest.raises(AttributeError, match="no attribute 'plays'; its front doors are api, backend, blocks, encode"):
        _ = gsstream.plays


def test_what_a_step_says_is_what_a_player_makes_of_its_packet() -> None:
    player = None
    for step in whole("growing rigid with keys"):
        player = decode_packet(player, step.packet.data)
        same_bits(player.gaussians, step.state.player.gaussians)
        assert step.packet.kind is PacketKind[step.status.upper()]
        assert sum(step.metrics["bytes"].values()) == len(step.packet.data)
        assert step.metrics["num_gaussians"] == len(player.gaussians)
