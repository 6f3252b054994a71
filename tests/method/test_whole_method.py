"""The engine holds a whole method to its packets, lends it what it asks for, and refuses keys it would not read."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gsstream.cli.main import run_command
from gsstream.core.changes import Delta, Displacement, Groups
from gsstream.core.errors import ComponentError, RecipeError
from gsstream.discovery.catalog import load_catalog
from gsstream.engine.assembly.assemble import assemble
from gsstream.engine.assembly.checks import Checks
from gsstream.engine.budget.plan import unlimited
from gsstream.engine.run.encoder import Callbacks, Encoder
from gsstream.engine.run.player_difference import difference_between
from gsstream.engine.run.run_frame import RepeatedFrameWarning, SkippedWorkWarning
from gsstream.input.recordings.open import open_source
from gsstream.method.base import StreamingMethod
from gsstream.method.packets import send_delta
from gsstream.method.static import Hold, StaticState
from gsstream.packet import PacketKind
from gsstream.parts.render.exposure import Exposure
from gsstream.parts.render.wrt import WrtRows
from gsstream.player.playback import Playback
from gsstream.recipe.load import resolve_recipe
from gsstream.recipe.model import Stream
from gsstream.testing.examples.streaming_method import ExampleMethod
from gsstream.testing.method_driver import SOURCE, MethodUnderTest
from gsstream.testing.streaming_method import check_method_closed_loop, check_method_resume

Follow: Any = ExampleMethod  # final: only what is wrong on purpose may inherit from it

RUN = [
    "run", "--source", SOURCE, "--method", "dense", "--quiet", "--no-pictures", "--set", "first_frame.max_iterations=5",
    "--set", "first_frame.points=recording",
]  # fmt: skip


class Spoilt(Hold):  # type: ignore[misc]  # wrong on purpose
    """Holds, and then does one thing wrong in ``spoil``."""

    def step(self, state, frame, tools):
        return self.spoil(super().step(state, frame, tools))


def spoilt(wrong) -> StreamingMethod:
    return type("Wrong", (Spoilt,), {"spoil": lambda _, step: wrong(step)})()


def stepped(part: StreamingMethod, repeat: bool = False, **changes: Any) -> Any:
    """Frame 1 after frame 0, by a whole method; ``repeat``: the recipe's ``stream.on_error``."""
    subject = repeating(MethodUnderTest("dense", part)) if repeat else MethodUnderTest("dense", part)
    subject.assembly = replace(subject.assembly, **changes)
    start = subject.begin(open_source(SOURCE).frame(0))
    return subject.step(start.state, open_source(SOURCE).frame(1))


def with_scene(step, **changes):
    player = step.state.player
    return replace(step, state=StaticState(replace(player, scene=replace(player.scene, **changes))))


def drift(step):
    gaussians = step.state.player.gaussians
    return with_scene(step, gaussians=replace(gaussians, means=gaussians.means + np.float32(0.25)))


def lose_one(step):
    return with_scene(step, gaussians=step.state.player.gaussians.rows(slice(1, None)))


def remember(step):
    """Claims that a row moved, where players have forgotten it: the next motion would be predicted from it."""
    one = np.ones((1, 3), np.float32)
    return with_scene(step, displacement=Displacement(np.array([0]), one, one))


def regroup(step):
    number = len(step.state.player.gaussians)
    return with_scene(step, groups=Groups(1.0, 1, np.zeros(number, np.int32), 1))


def stand_still(step):
    return replace(step, state=StaticState(replace(step.state.player, frame=0)))


def keep_decoder(step):
    player = replace(step.state.player, decoders={"sh0": np.ones((1, 3), np.float32)})
    return replace(step, state=StaticState(player))


def other_layout(step):
    return with_scene(step, layout=replace(step.state.player.layout, units=np.array([9.0], np.float32)))


def test_a_decoder_of_its_own_is_refused_where_it_is_declared() -> None:
    """Players would never call it."""
    with pytest.raises(TypeError, match=r"Own\.decoder: every player decodes packets in the same way"):
        type("Own", (Hold,), {"decoder": lambda _: None})


def misname(step):
    return replace(step, status="delta")


def another_frame(step):
    packet, player = send_delta(step.state.player, Delta())
    return replace(step, packet=packet, state=StaticState(player))


def fail(_step):
    raise RuntimeError("out of ideas")


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (drift, "its state is not what players have after its packet: means is off by up to 0.25"),
        (lose_one, "means has the shape ["),
        (stand_still, "frame 0 instead of 1"),
        (keep_decoder, "packet: decoders"),
        (other_layout, "packet: layout: units"),
        (remember, "packet: scene: displacement"),
        (regroup, "packet: scene: groups"),
        (misname, "expected a packet of frame 1 of the kind it says, 'delta'; got 'empty' of frame 1"),
        (another_frame, "got 'empty' of frame 2"),
        (fail, "failed at frame 1: RuntimeError: out of ideas"),
    ],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_a_state_that_players_do_not_have_is_an_error(wrong, message: str) -> None:
    with pytest.raises(ComponentError) as caught:
        stepped(spoilt(wrong))
    assert message in str(caught.value)
    assert (caught.value.slot, caught.value.part, caught.value.frame) == ("streaming_method", "Wrong", 1)


def test_a_packet_that_lies_about_what_it_was_decoded_to_is_found_where_every_step_is_checked() -> None:
    def lie(step):
        wrong = drift(step)
        return replace(wrong, packet=replace(wrong.packet, decoded=wrong.state.player))

    with pytest.raises(ComponentError, match=r"means is off by up to 0\.25"):
        stepped(spoilt(lie), checks=Checks.STEP)
    with pytest.raises(AssertionError, match=r"frame 1: .* means is off by up to 0\.25"):
        check_method_closed_loop(MethodUnderTest("dense", spoilt(lie)))


@pytest.mark.parametrize(
    ("field", "value"), [("cell", 2.0), ("brightness_bins", 3), ("count", 2), ("group_of", np.ones(12, np.int32))]
)
def test_groups_are_compared_field_by_field(begun, field: str, value: Any) -> None:
    """Equal rows under another cell or in more groups: the marks of the next motion would be of other groups."""
    player = begun[1]
    groups = Groups(1.0, 2, np.zeros(12, np.int32), 1)
    known = replace(player, scene=replace(player.scene, groups=groups))
    claimed = replace(player, scene=replace(player.scene, groups=replace(groups, **{field: value})))
    assert difference_between(known, replace(known)) == ""
    assert difference_between(known, claimed) == f"scene: groups, {field}"


def repeating(subject: MethodUnderTest) -> MethodUnderTest:
    recipe = subject.assembly.recipe
    stream = recipe.stream.model_copy(update={"on_error": "repeat"})
    subject.assembly = replace(subject.assembly, recipe=recipe.model_copy(update={"stream": stream}))
    return subject


class FailsAt1(Follow):  # type: ignore[misc]  # wrong on purpose
    """Follows the light, and fails at frame 1 unless it is worth nothing."""

    def step(self, state, frame, tools):
        if frame.index == 1 and frame.epoch_scale > 0:
            raise RuntimeError("out of ideas")
        return super().step(state, frame, tools)


def test_a_failed_frame_is_repeated_when_the_recipe_says_so() -> None:
    subject = repeating(MethodUnderTest("dense", FailsAt1()))
    source = open_source(SOURCE)
    start = subject.begin(source.frame(0))
    with pytest.warns(RepeatedFrameWarning, match=r"frame 1 repeats .* 'FailsAt1' .* RuntimeError: out of ideas"):
        failed = subject.step(start.state, source.frame(1))
    assert failed.status == "empty"
    assert failed.packet.kind == PacketKind.EMPTY
    assert "out of ideas" in failed.metrics["error"]
    assert failed.metrics["seconds"]["failed"] > 0
    for name, value in failed.state.player.gaussians.items():
        assert np.array_equal(value, getattr(start.state.player.gaussians, name))
    after = subject.step(failed.state, source.frame(2))
    assert (after.packet.frame, after.status) == (2, "delta")
    assert "error" not in after.metrics


class Stubborn(Follow):  # type: ignore[misc]  # wrong on purpose
    """Sends something in place of a frame that failed."""

    def step(self, state, frame, tools):
        if frame.epoch_scale > 0:
            raise RuntimeError("out of ideas")
        return super().step(state, replace(frame, epoch_scale=1.0), tools)


class Ponders(Hold):  # type: ignore[misc]  # wrong on purpose
    """Holds, and then does in ``ponder`` what its packets need not wait for."""

    def follow_up(self, state, step, frame, tools):
        tools.log.add(thoughts=1)
        return self.ponder(state, step, frame)


def pondering(ponder) -> StreamingMethod:
    return type("Wrong", (Ponders,), {"ponder": lambda _, *given: ponder(*given)})()


@dataclass(frozen=True)
class Thought:
    """What the player has, and the frame that was thought about last."""

    player: Any
    about: int


def test_the_packet_is_out_before_the_work_that_follows_it() -> None:
    told: list[tuple[str, int]] = []

    def ponder(state, step, frame):
        told.append(("follow up", frame.index))
        assert state.player.frame == frame.index - 1
        return replace(step, state=Thought(step.state.player, frame.index))

    subject = MethodUnderTest("dense", pondering(ponder))
    source = open_source(SOURCE)
    listeners = Callbacks(packet=lambda packet: told.append(("packet", packet.frame)))
    encoder = Encoder(subject.assembly, source.info, lambda _: source.points("recording"), callbacks=listeners)
    steps = [encoder.encode(source.frame(index)) for index in range(3)]
    assert told == [("packet", 0), ("packet", 1), ("follow up", 1), ("packet", 2), ("follow up", 2)]
    assert [getattr(step.state, "about", None) for step in steps] == [None, 1, 2]
    for step in steps[1:]:
        assert step.metrics["thoughts"] == 1
        assert step.metrics["num_gaussians"] == len(step.state.player.gaussians)
        assert set(step.metrics["seconds"]) == {"other"}
        assert step.metrics["seconds"]["other"] > 0


def swap_packet(_state, step, _frame):
    return replace(step, packet=replace(step.packet, data=step.packet.data[:-1]))


def swap_status(_state, step, _frame):
    return replace(step, status="delta")


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (swap_packet, "packet or status"),
        (swap_status, "packet or status"),
        (lambda _state, step, _frame: drift(step), "means is off by up to 0.25"),
    ],
    ids=["packet", "status", "player"],
)
def test_what_has_been_handed_out_is_not_changed_afterwards(wrong, message: str) -> None:
    with pytest.raises(ComponentError, match="its follow_up changed what has been handed out: ") as caught:
        stepped(pondering(wrong))
    assert message in str(caught.value)
    assert (caught.value.slot, caught.value.part, caught.value.frame) == ("streaming_method", "Wrong", 1)


def test_what_fails_after_a_packet_leaves_the_encoder_as_it_was_and_gives_the_packet_again() -> None:
    sent, broken = [], [True]

    def ponder(state, step, frame):
        if broken:
            broken.clear()
            raise RuntimeError("out of ideas")
        return step

    subject, source = MethodUnderTest("dense", pondering(ponder)), open_source(SOURCE)
    listeners = Callbacks(packet=sent.append)
    encoder = Encoder(subject.assembly, source.info, lambda _: source.points("recording"), callbacks=listeners)
    before = encoder.encode(source.frame(0)).state
    with pytest.raises(
        ComponentError, match=r"streaming_method 'Wrong' .* failed at frame 1: RuntimeError: out of ideas"
    ):
        encoder.encode(source.frame(1))
    assert encoder.state is before
    encoder.encode(source.frame(1))
    assert [packet.frame for packet in sent] == [0, 1, 1]
    assert sent[1].data == sent[2].data


def test_what_fails_after_a_packet_is_left_out_when_the_recipe_says_so() -> None:
    asked: list[float] = []

    def ponder(state, step, frame):
        asked.append(frame.epoch_scale)
        if frame.epoch_scale > 0:
            raise RuntimeError("out of ideas")
        return replace(step, state=Thought(step.state.player, -1))

    said = r"frame 1: its packet is sound, but .* left out: streaming_method 'Wrong'"
    with pytest.warns(SkippedWorkWarning, match=said):
        step = stepped(pondering(ponder), repeat=True)
    assert asked == [1, 0]
    assert step.state.about == -1
    assert "out of ideas" in step.metrics["error"]
    assert step.metrics["seconds"]["failed"] > 0


@pytest.mark.parametrize("part", [spoilt(fail), Stubborn(), pondering(lambda *_: fail(None))], ids=repr)
def test_what_cannot_be_skipped_either_ends_the_run(part: StreamingMethod) -> None:
    """A step, what is sent in its place and is not empty, and the work after a packet."""
    with pytest.raises(ComponentError, match="out of ideas"):
        stepped(part, repeat=True)


class Tires(Follow):  # type: ignore[misc]  # wrong on purpose
    """Follows the light for one frame; thinks about it after its packet, and rests from then on."""

    def step(self, state, frame, tools):
        return super().step(state, replace(frame, epoch_scale=0.0) if isinstance(state, Thought) else frame, tools)

    def follow_up(self, state, step, frame, tools):
        return replace(step, state=Thought(step.state.player, frame.index))


class Remembers(Tires):
    """The same, and knows it when it is resumed."""

    def resume(self, player, shown, tools):
        return Thought(player, player.frame)


def test_the_contract_kit_finds_what_a_resumed_run_forgets_of_that_work() -> None:
    check_method_resume(MethodUnderTest("dense", Remembers(Follow.Config(step=1e-4))))
    with pytest.raises(AssertionError, match="resumed run: packet of frame 2 differs"):
        check_method_resume(MethodUnderTest("dense", Tires(Follow.Config(step=1e-4))))


def refusal(*sets: str, method: str = "hold") -> list[str]:
    catalog = load_catalog()
    overrides = [("--set", text) for text in ("renderer=reference", *sets)]
    with pytest.raises(RecipeError) as caught:
        assemble(resolve_recipe(method, catalog.recipe_path, (), overrides), catalog)
    return str(caught.value).splitlines()


def test_keys_that_a_whole_method_does_not_read_are_refused() -> None:
    why = "the streaming_method 'hold' does not read it; its own settings: gsstream plugins streaming_method/hold"
    assert refusal("structure.resolution=64", "stream.rd_lambda=0.5", "stream.epochs=3", "update.sh0.lr=1.0") == [
        "4 problems in the recipe:",
        f"  --set structure.resolution=64: structure.params: {why}",
        f"  --set update.sh0.lr=1.0: update.params: {why}",
        f"  --set stream.epochs=3: stream.epochs: {why}",
        f"  --set stream.rd_lambda=0.5: stream.rd_lambda: {why}",
    ]
    # Written, but not changed: a saved recipe spells every default out.
    catalog = load_catalog()
    sets = [("--set", text) for text in ("renderer=reference", "stream.epochs=20", "structure.resolution=1024")]
    assembly = assemble(resolve_recipe("hold", catalog.recipe_path, (), sets), catalog)
    assert isinstance(assembly.part("streaming_method"), Hold)
    assert assemble(assembly.recipe, catalog).recipe == assembly.recipe


def test_settings_of_a_whole_method() -> None:
    wanted = "unknown key 'streaming_method.params.speed'; none are registered"
    assert refusal("streaming_method.speed=3") == [f"--set streaming_method.speed=3: {wanted}"]
    assert (
        "streaming_method.name: no streaming_method named 'hodl'; did you mean 'hold'?"
        in refusal("streaming_method=hodl")[0]
    )
    assert wanted in refusal("streaming_method.speed=3", method="dense")[0]


def test_any_recipe_may_name_one(tmp_path: Path) -> None:
    """``--set whole=NAME`` is enough to run a part that ships no recipe."""
    assert run_command([*RUN, "--set", "streaming_method=hold", "--out", str(tmp_path / "o")]) == 0
    with Playback(tmp_path / "o" / "stream.gss") as playback:
        assert [playback.entry(f).kind for f in playback.frames] == [PacketKind.KEY, *[PacketKind.EMPTY] * 3]
        assert len({playback.state_at(frame).means.tobytes() for frame in playback.frames}) == 1
    assert run_command(["info", str(tmp_path / "o")]) == 0
    assert run_command(["evaluate", str(tmp_path / "o"), "--source", SOURCE]) == 0


def test_the_benchmark_of_the_parts_refuses_a_whole_method(capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["bench", "frame", "--method", "hold", "--quick"]) == 2
    assert "expected a method made of parts, got the streaming_method 'hold'" in capsys.readouterr().err


@pytest.fixture(scope="module")
def begun():
    """(subject, what a player has after frame 0, frame 0, frame 1)"""
    subject = MethodUnderTest("dense", Hold())
    source = open_source(SOURCE)
    return subject, subject.begin(source.frame(0)).state.player, source.frame(0), source.frame(1)


class TestTools:
    """What the engine lends, against the same thing computed apart."""

    def test_a_gradient_is_that_of_the_loss_through_the_colour_map(self, begun) -> None:
        subject, player, before, now = begun
        generator = torch.Generator().manual_seed(3)
        matrix = torch.eye(3) + 0.1 * torch.randn(3, 3, 3, generator=generator)
        offset = 0.1 * torch.randn(3, 3, generator=generator)
        extra = {**player.meta.extra, "exposure": {"matrix": matrix.tolist(), "offset": offset.tolist()}}
        work = subject.encoder()._tools().open(replace(player, meta=replace(player.meta, extra=extra)), before, now)
        found, loss = work.loss_and_grad(1, WrtRows(work.gaussians)), subject.assembly.renderer.loss
        leaves = work.gaussians.map(lambda value: value.clone().requires_grad_())
        drawn = subject.assembly.renderer.render(leaves, now.cameras, 1, subject.assembly.background).image
        shown = Exposure(matrix, offset)[1].apply(drawn)
        want, gradient = loss.evaluate(shown.detach(), loss.prepare(torch.from_numpy(now.images[1])), 0.2)
        shown.backward(gradient)
        assert float(found.loss) == pytest.approx(float(want), rel=1e-6)
        scale = float(leaves.sh0.grad.abs().max())
        assert scale > 0
        torch.testing.assert_close(found.grad.sh0, leaves.sh0.grad, rtol=0, atol=1e-4 * scale)

    def test_a_tile_of_weight_zero_is_left_out(self, begun) -> None:
        subject, player, before, now = begun
        work = subject.encoder()._tools().open(player, before, now)
        weights = torch.zeros(2, 2)
        target = work.view_target(0, weights)
        assert target.tile_weights is weights
        assert float(work.session.loss_and_grad(0, target, WrtRows(work.gaussians)).loss) == 0
        weights[0, 1] = 1
        found = work.session.loss_and_grad(0, target, WrtRows(work.gaussians))
        drawn = work.session.visible(0, weights > 0)
        moved = found.grad.means.abs().amax(1) > 0
        assert bool(moved.any()), "the tile that counts has Gaussians"
        assert not bool((moved & ~drawn).any()), "no other Gaussian has a gradient"

    def test_a_frame_that_is_worth_less_has_fewer_epochs(self, begun) -> None:
        subject, _, _, now = begun
        made = subject.encoder()
        made._unlimited = unlimited(Stream())
        tools = made._tools()
        assert [tools.epochs(replace(now, epoch_scale=e)) for e in (1.0, 0.5, 0.01)] == [20, 10, 1]


#: at_hand.yaml lists the scenes of a sweep.
RECORDINGS = sorted(
    file for file in Path(__file__).parents[2].glob("configs/recordings/*.yaml") if file.stem != "at_hand"
)


@pytest.mark.parametrize("file", RECORDINGS, ids=[file.stem for file in RECORDINGS])
def test_the_recipe_of_a_recording_serves_every_method(file: Path) -> None:
    """It describes how frame 0 is made, which the engine does for all methods."""
    catalog = load_catalog()
    for method in catalog.names("method"):
        sets = [("--set", "renderer=reference")]
        assembly = assemble(resolve_recipe(method, catalog.recipe_path, [file], sets), catalog)
        assert assembly.recipe.method == method
