"""Saboteurs of the checks of whole methods: a sound method, one of whose steps is spoilt."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch

from gsstream.core.frame import Frame
from gsstream.engine.run.encoder import EncodedFrame
from gsstream.input.recordings.open import open_source
from gsstream.packet import KeyState, PlayerState, decode_packet, encode_key
from gsstream.testing.cases import fingerprint
from gsstream.testing.method_driver import FRAMES, SOURCE, MethodUnderTest

METHOD_SABOTEURS: dict[str, type[MethodUnderTest]] = {}


class Remembered(MethodUnderTest):
    """A sound method that encodes each frame once for all saboteurs: what they spoil lies around it."""

    memory: ClassVar[dict[bytes, EncodedFrame]] = {}

    def begin(self, frame: Frame, uri: str = SOURCE) -> EncodedFrame:
        key = b"".join([uri.encode(), *fingerprint(frame)])
        if key not in self.memory:
            self.memory[key] = super().begin(frame, uri)
        return self.memory[key]

    def step(self, state: Any, frame: Frame) -> EncodedFrame:
        seen = (state.player.gaussians, state.previous, frame)
        key = b"".join([*fingerprint(seen), str(frame.epoch_scale).encode()])
        if key not in self.memory:
            self.memory[key] = super().step(state, frame)
        return self.memory[key]


def _spoils(check: str) -> Callable[[type[MethodUnderTest]], type[MethodUnderTest]]:
    def enter(cls: type[MethodUnderTest]) -> type[MethodUnderTest]:
        METHOD_SABOTEURS[check] = cls
        return cls

    return enter


@_spoils("check_method_closed_loop")
class DriftingPlayer(Remembered):
    """The player is an ulp off."""

    def play(self, state: PlayerState | None, data: bytes) -> PlayerState:
        after = super().play(state, data)
        means = np.nextafter(after.gaussians.means, np.float32(np.inf))
        return replace(after, scene=replace(after.scene, gaussians=replace(after.gaussians, means=means)))


@_spoils("check_method_deterministic")
class Moody(Remembered):
    """No two runs write the same first packet."""

    runs = 0

    def begin(self, frame: Frame, uri: str = SOURCE) -> EncodedFrame:
        step = super().begin(frame, uri)
        self.runs += 1
        if self.runs == 1:
            return step
        data = step.packet.data
        return replace(step, packet=replace(step.packet, data=data[:-1] + bytes([data[-1] ^ 1])))


@_spoils("check_method_resume")
class Amnesiac(Remembered):
    """Resumes with a scene that is a hundredth off."""

    def resume(self, stream: Path) -> Any:
        state = super().resume(stream)
        assert state is not None
        gaussians = replace(state.player.gaussians, means=state.player.gaussians.means + np.float32(0.01))
        return replace(state, player=replace(state.player, gaussians=gaussians))


@_spoils("check_method_failed_frame")
class Clumsy(Remembered):
    """A failure spoils the state."""

    memory: ClassVar[dict[bytes, EncodedFrame]] = {}

    def step(self, state: Any, frame: Frame) -> EncodedFrame:
        try:
            return super().step(state, frame)
        except Exception:
            state.player.gaussians.means[0] += 1
            raise


@_spoils("check_method_static_video")
class Nervous(Remembered):
    """Sends most when nothing moves."""

    def step(self, state: Any, frame: Frame) -> EncodedFrame:
        step = super().step(state, frame)
        if not np.array_equal(frame.images, state.previous.images):
            return step
        return replace(step, packet=replace(step.packet, data=step.packet.data * 9))


@_spoils("check_method_one_camera")
class Stereo(Remembered):
    """Needs two cameras."""

    def step(self, state: Any, frame: Frame) -> EncodedFrame:
        if len(frame.cameras) < 2:
            raise ValueError("expected at least two cameras")
        return super().step(state, frame)


@_spoils("check_method_declared_needs")
class Optimist(Remembered):
    """Starts without a camera, from what it has seen before."""

    def begin(self, frame: Frame, uri: str = SOURCE) -> EncodedFrame:
        return super().begin(frame, uri) if len(frame.cameras) else super().begin(open_source(uri).frame(0), uri)


@_spoils("check_method_size_is_true")
class Boaster(Remembered):
    """Reports half of the bytes."""

    def step(self, state: Any, frame: Frame) -> EncodedFrame:
        step = super().step(state, frame)
        sizes = {name: size // 2 for name, size in step.packet.sizes.items()}
        return replace(step, metrics={**step.metrics, "bytes": sizes})


@_spoils("check_method_global_rng")
class Gambler(Remembered):
    """Draws from the global generator."""

    def step(self, state: Any, frame: Frame) -> EncodedFrame:
        torch.rand(1)
        return super().step(state, frame)


@_spoils("check_method_inputs_unchanged")
class Scribbler(Remembered):
    """Darkens the images of the last frame once it is done with them."""

    def step(self, state: Any, frame: Frame) -> EncodedFrame:
        step = super().step(state, frame)
        if frame.index == FRAMES - 1:
            frame.images[...] *= np.float32(0.5)
        return step


@_spoils("check_method_reuses_first_frame")
class Stubborn(Remembered):
    """Reconstructs frame 0 although it was given one."""

    def take_over(self, first: PlayerState, frame: Frame) -> EncodedFrame:
        return self.begin(frame)


@_spoils("check_method_meta")
class Impostor(Remembered):
    """Signs its stream with another method's name."""

    def begin(self, frame: Frame, uri: str = SOURCE) -> EncodedFrame:
        step = super().begin(frame, uri)
        player = step.state.player
        meta = replace(player.meta, method="somebody-else")
        packet = encode_key(KeyState(player.gaussians, player.layout, meta), frame=frame.index)
        state = replace(step.state, player=decode_packet(None, packet.data))
        return replace(step, packet=packet, state=state, metrics={**step.metrics, "bytes": dict(packet.sizes)})


@_spoils("check_method_skips")
class Workaholic(Remembered):
    """Does every frame in full, whatever it is worth."""

    def step(self, state: Any, frame: Frame) -> EncodedFrame:
        return super().step(state, replace(frame, epoch_scale=1.0))
