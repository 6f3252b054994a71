"""What a method promises, on a recording of 32 x 24 pixels."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from gsstream.core.errors import STRANGERS, InputError
from gsstream.core.frame import Frame
from gsstream.core.gaussians import Gaussians
from gsstream.core.shapes import FloatArray, check_finite
from gsstream.engine.run.encoder import EncodedFrame
from gsstream.input.recordings.open import open_source
from gsstream.packet import StreamWriter, quantise_key
from gsstream.testing.cases import fingerprint
from gsstream.testing.method_driver import FRAMES, SOURCE, MethodUnderTest, check_replay
from gsstream.testing.registry import check

CUT = 2


def _bytes(what: str, got: EncodedFrame, expected: EncodedFrame) -> None:
    a, b = got.packet.data, expected.packet.data
    if a == b:
        return
    pairs = zip(a, b, strict=False)
    place = next((i for i, (x, y) in enumerate(pairs) if x != y), min(len(a), len(b)))
    frame = expected.packet.frame
    raise AssertionError(f"{what}: packet of frame {frame} differs from byte {place} on ({len(a)} and {len(b)} bytes)")


@check("method", kinds=("method", "streaming_method"))
def check_method_closed_loop(method: MethodUnderTest) -> None:
    """A fresh player that has the packets alone reaches the encoder's state bit by bit, frame by frame."""
    check_replay(method, method.steps)


@check("method", kinds=("method", "streaming_method"))
def check_method_deterministic(method: MethodUnderTest) -> None:
    """The same seed gives the same packets, byte by byte."""
    for again, first in zip(method.chain(), method.steps, strict=True):
        _bytes("second run", again, first)


@check("method", kinds=("method", "streaming_method"))
def check_method_resume(method: MethodUnderTest) -> None:
    """Stopped after frame 1 and continued from the stream alone, the rest is byte by byte the same."""
    with tempfile.TemporaryDirectory() as folder:
        stream = Path(folder, "stream.gss")
        with StreamWriter.open(stream) as writer:
            for step in method.steps[:CUT]:
                writer.append(step.packet)
        state = method.resume(stream)
    assert state is not None, "nothing to resume was found in a stream of two frames"
    source = open_source(SOURCE)
    for index in range(CUT, FRAMES):
        again = method.step(state, source.frame(index))
        _bytes("resumed run", again, method.steps[index])
        state = again.state


@check("method", kinds=("method", "streaming_method"))
def check_method_failed_frame(method: MethodUnderTest) -> None:
    """A frame that fails leaves the state as it was; the next attempt gives what it would have given."""
    state = method.steps[1].state
    before = fingerprint(state.player)
    frame = open_source(SOURCE).frame(2)
    broken = replace(frame, images=frame.images[:, :-1])
    try:
        method.step(state, broken)
    except STRANGERS as error:  # the method chooses which error; the check is that the state survives
        assert str(error), f"a frame one row short raised {type(error).__name__} without a message"
    assert fingerprint(state.player) == before, "the failed frame changed the state"
    _bytes("after a failed frame", method.step(state, frame), method.steps[2])


@check("method", kinds=("method", "streaming_method"))
def check_method_static_video(method: MethodUnderTest) -> None:
    """When nothing moves, frames cost no more than when something does."""
    still = method.chain(SOURCE + "&static=true")
    sizes = [[len(step.packet.data) for step in steps[1:]] for steps in (still, method.steps)]
    got, bound = (sum(size) for size in sizes)
    assert got <= 1.1 * bound, (
        f"a static recording takes {sizes[0]} bytes, the moving one {sizes[1]}; expected at most a tenth more (without "
        "gates every frame spends its whole budget)"
    )


@check("method", kinds=("method", "streaming_method"))
def check_method_one_camera(method: MethodUnderTest) -> None:
    """One camera, or as many as it says it needs, are enough to run, and everything stays finite."""
    for step in method.chain(choose=lambda frame: _with_cameras(frame, method.min_cameras)):
        for name, value in step.state.player.gaussians.items():
            check_finite(f"frame {step.packet.frame}: {name}", value)


def _with_cameras(frame: Frame, number: int) -> Frame:
    return replace(frame, images=frame.images[:number], cameras=frame.cameras.select(range(number)))


@check("method", kinds=("method", "streaming_method"))
def check_method_declared_needs(method: MethodUnderTest) -> None:
    """With one camera fewer than it says it needs, frame 0 is refused by an InputError that says how many."""
    frame = _with_cameras(open_source(SOURCE).frame(0), method.min_cameras - 1)
    try:
        method.begin(frame)
    except InputError as error:
        assert str(method.min_cameras) in str(error), f"the error does not say how many cameras are needed: {error}"
        return
    raise AssertionError(f"started with {len(frame.cameras)} cameras; it says it needs {method.min_cameras}")


@check("method", kinds=("method", "streaming_method"))
def check_method_size_is_true(method: MethodUnderTest) -> None:
    """Reported bytes are the bytes written, and no more Gaussians change or gates are open than there are."""
    for step in method.steps:
        metrics = step.metrics
        total = sum(metrics["bytes"].values())
        frame = step.packet.frame
        assert total == len(step.packet.data), f"frame {frame}: says {total} bytes, wrote {len(step.packet.data)}"
        for which, name in (("changed", "gaussians"), ("active", "gates")):
            some, have = metrics[f"{which}_{name}"], metrics[f"num_{name}"]
            assert 0 <= some <= have, f"frame {frame}: {some} {which} {name} of {have}"


@check("method", kinds=("method", "streaming_method"))
def check_method_global_rng(method: MethodUnderTest) -> None:
    """Torch's global generator is neither read nor moved by a frame."""
    state, frame = method.steps[0].state, open_source(SOURCE).frame(1)
    before = torch.get_rng_state()
    again = method.step(state, frame)
    assert torch.equal(before, torch.get_rng_state()), "the frame drew from torch's global generator"
    _bytes("frame 1 again", again, method.steps[1])


@check("method", kinds=("method", "streaming_method"))
def check_method_inputs_unchanged(method: MethodUnderTest) -> None:
    """A frame leaves the images it was given and the state it started from as they were."""
    state, frame = method.steps[1].state, open_source(SOURCE).frame(2)
    before = fingerprint((frame.images, state.player))
    method.step(state, frame)
    assert fingerprint((frame.images, state.player)) == before, "the frame changed its images or the state before it"


@check("method", kinds=("method", "streaming_method"))
def check_method_reuses_first_frame(method: MethodUnderTest) -> None:
    """Given frame 0 of another stream, it starts from exactly those Gaussians, in an order of its own."""
    own = method.steps[0].state.player
    given = quantise_key(replace(own.gaussians, means=own.gaussians.means / 2))
    step = method.take_over(replace(own, scene=replace(own.scene, gaussians=given)), open_source(SOURCE).frame(0))
    want, got = _sorted_rows(given), _sorted_rows(step.state.player.gaussians)
    assert want.shape == got.shape, f"expected {len(want)} Gaussians of {want.shape[1]} values, got {list(got.shape)}"
    off = int((want != got).any(1).sum())
    assert off == 0, f"{off} of {len(want)} Gaussians are not those of the frame that was given"


def _sorted_rows(gaussians: Gaussians[FloatArray]) -> FloatArray:
    rows = np.concatenate([value.reshape(len(value), -1) for _, value in gaussians.items()], axis=1)
    return np.asarray(rows[np.lexsort(rows.T)])


@check("method", kinds=("method", "streaming_method"))
def check_method_meta(method: MethodUnderTest) -> None:
    """The key packet names the method and carries the recipe and the cameras of the run."""
    meta, recipe = method.steps[0].state.player.meta, method.assembly.recipe
    assert meta.method == recipe.method, f"method: expected {recipe.method!r}, got {meta.method!r}"
    assert meta.recipe == recipe.model_dump(mode="json"), "the recipe in the key packet is not the one of the run"
    info = open_source(SOURCE).info
    for split, want, have in (("training", info.train, meta.train), ("test", info.test, meta.test)):
        assert have.ids == want.ids, f"{split} cameras: expected {want.ids}, got {have.ids}"


@check("method", kinds=("method", "streaming_method"))
def check_method_skips(method: MethodUnderTest) -> None:
    """A frame whose epoch scale is 0 becomes an empty packet, and the stream goes on from it."""
    state, frame = method.steps[0].state, open_source(SOURCE).frame(1)
    step = method.step(state, replace(frame, epoch_scale=0.0))
    assert step.status == "empty", f"expected an empty packet, got {step.status} ({step.packet.sizes})"
    after = method.step(step.state, open_source(SOURCE).frame(2))
    assert after.packet.frame == 2, f"expected to go on with frame 2, got {after.packet.frame}"
