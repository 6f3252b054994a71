"""What an author reads first says what is wrong: that a shape is, and where in their file something failed."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import torch

from gsstream.testing import run_checks
from gsstream.testing.examples.confidence import ExampleConfidence
from gsstream.testing.examples.gate import ExampleGate
from gsstream.testing.examples.propagation import ExamplePropagation

Gate: Any = ExampleGate
Confidence: Any = ExampleConfidence
Propagation: Any = ExamplePropagation
SHORT = [
    (Gate, "init"),
    (Gate, "sample"),
    (Gate, "open_probability"),
    (Gate, "bound"),
    (Confidence, "estimate"),
    (Propagation, "propagate"),
]


@pytest.mark.parametrize(("part", "method"), SHORT)
def test_a_row_too_few_is_called_so_before_anything_else(part: Any, method: str) -> None:
    whole = getattr(part, method)

    def short(self: Any, *args: Any) -> torch.Tensor:
        found: torch.Tensor = whole(self, *args)
        return found[:-1]

    made = type(f"Short{part.__name__}", (part,), {method: short, "__doc__": "A row too few.", "__final__": True})
    failed = [result.message for result in run_checks(made()) if result.status == "failed"]
    assert re.match(r"\w+\(.*\): expected shape \[\d+\], got \[\d+\]$", failed[0])
    want, got = (int(number) for number in re.findall(r"\[(\d+)\]", failed[0]))
    assert want == got + 1


class FromCameras(Confidence):
    """Mixes an array of the cameras, which is on the processor, with Gaussians, which need not be."""

    def estimate(self, context: Any) -> torch.Tensor:
        turn = torch.from_numpy(context.cameras.viewmats[0, :3, :3]) if len(context.cameras) else torch.eye(3)
        depth = context.gaussians.means @ turn.float().T  # this line
        return (0 * depth[:, 2] - 10).float()


class Undefined(Confidence):
    """Divides by nothing."""

    def estimate(self, context: Any) -> torch.Tensor:
        return context.no_such_thing  # that line


@pytest.mark.parametrize(("part", "mark", "check"), [(FromCameras, "this", "device"), (Undefined, "that", "pure")])
def test_where_a_part_failed_is_said_with_file_and_line(part: Any, mark: str, check: str) -> None:
    lines = Path(__file__).read_text(encoding="utf-8").splitlines()
    (line,) = [number for number, text in enumerate(lines, 1) if text.endswith(f"# {mark} line")]
    (said,) = [result.message for result in run_checks(part()) if result.check == f"check_{check}"]
    assert f"(test_first_line.py:{line})" in said
    assert ("context.cameras are numpy" in said) == (check == "device")
