"""What a process of a run loads: libraries that torch loads besides cost seconds and memory of every start."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch
from flow_runs import demo_copy

from gsstream.parts.render.backward import backward

#: Seconds and tens of megabytes each; nothing of them is ever used.
UNWANTED = ("torch._dynamo", "torch._inductor", "sympy", "torch.fx.experimental.symbolic_shapes")


@pytest.mark.parametrize(
    ("method", "passes"), [("s2gs-edge", ["stream.epochs=1"]), ("hicom", ["motion.epochs=1", "growth.epochs=1"])]
)
def test_a_run_loads_no_compiler_and_no_symbols(tmp_path: Path, method: str, passes: list[str]) -> None:
    """Neither where motions and residuals are fitted, nor where Gaussians are added and fitted."""
    source = demo_copy(tmp_path / "demo", frames=2)
    arguments = ["run", "--method", method, "--source", str(source), "--out", str(tmp_path / "out"), "--no-video"]
    settings = ["first_frame.epochs=1", *passes]
    arguments += ["--quiet", *(word for setting in settings for word in ("--set", setting))]
    program = f"""
import sys
from gsstream.cli.main import main
try:
    main({arguments!r})
except SystemExit as end:
    assert not end.code, end.code
print([name for name in {UNWANTED!r} if name in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize("count", [1, 3])
def test_backward_is_the_backward_of_torch(count: int) -> None:
    g = torch.Generator().manual_seed(count)
    leaves = [[torch.randn(5, 3, generator=torch.Generator().manual_seed(7)).requires_grad_()] for _ in range(2)]
    gradients = [torch.randn(5, 3, generator=g) for _ in range(count)]
    for (leaf,), differentiate in zip(leaves, (backward, torch.autograd.backward), strict=True):
        hidden = leaf.sin() * leaf.exp()
        differentiate([hidden * (k + 1) + hidden.square() for k in range(count)], gradients)
    (ours,), (theirs,) = leaves
    assert ours.grad is not None
    assert theirs.grad is not None
    assert torch.equal(ours.grad, theirs.grad)
