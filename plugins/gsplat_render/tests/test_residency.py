"""Frame 0, later frames and motion stay on the device, and compute there what they compute on the processor.

The device is the pretend one, so this needs no GPU: one tensor of the processor in a loop, one value that is read, and
a test fails. The budgets only ever go down.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from resident import CPU, DEVICE, method_on

from gsstream.core.frame import Frame
from gsstream.engine.frame0.optimise import FirstFrameRun
from gsstream.input.recordings.open import open_source
from gsstream.parts.motion.newton import DampedNewton
from gsstream.parts.optimiser.joint import JointResidualOptimiser
from gsstream.testing.method_driver import SOURCE
from gsstream.testing.pretend import PretendDevice

VIEWS = 3
#: Copies up, copies down and waits of one iteration.
RESIDENT = (0, 0, 0)
#: The same of a whole later frame: its pictures and the decoded change go up, the solution comes down.
FRAME = (0, 0, 0)
#: Kernels of an iteration of a later frame, of which gsplat's five are one each, and their gradients none.
LAUNCHES = 150


@pytest.fixture(scope="module")
def frames() -> list[Frame]:
    source = open_source(SOURCE)
    return [source.frame(index) for index in range(3)]


def counted(log: PretendDevice, cls: type, name: str, patch: pytest.MonkeyPatch) -> list[tuple[int, ...]]:
    """What crosses from the beginning of one call of a function to that of the next, and the launches between."""
    marks: list[tuple[int, ...]] = []
    call: Callable[..., Any] = getattr(cls, name)

    def marked(self: Any, *args: Any, **kwargs: Any) -> Any:
        marks.append((*log.crossings, log.launches))
        return call(self, *args, **kwargs)

    patch.setattr(cls, name, marked)
    return marks


def between(marks: list[tuple[int, ...]]) -> list[tuple[int, ...]]:
    return [tuple(b - a for a, b in zip(one, other, strict=True)) for one, other in zip(marks, marks[1:], strict=False)]


def packets(device: Any, frames: list[Frame]) -> list[bytes]:
    method = method_on(device)
    step = method.begin(frames[0])
    found = [step.packet.data]
    for frame in frames[1:]:
        step = method.step(step.state, frame)
        found.append(step.packet.data)
    return found
