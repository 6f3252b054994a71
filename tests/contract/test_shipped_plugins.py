"""``gsstream check`` of all that this repository ships ends well: what a part cannot keep, it denies with a reason."""

from __future__ import annotations

import pytest

from gsstream.cli.main import run_command
from gsstream.plugins.catalog import load_catalog

SHIPPED = {
    "gsstream": "builtin", "gsstream-s2gs": "s2gs", "gsstream-queen": "queen", "gsstream-cpu-render": "cpu",
    "gsstream-gsplat-render": "gsplat", "gsstream-ft-pruning": "ft-pruning", "gsstream-binary-ste": "binary-ste",
    "gsstream-onnx-confidence": "onnx", "gsstream-hicom": "hicom", "gsstream-comgs": "comgs",
    "gsstream-stream3dgs": "stream3dgs", "gsstream-recon": "recon", "gsstream-quarc": "quarc",
}  # fmt: skip
INSTALLED = [plugin.distribution for plugin in load_catalog().plugins if plugin.distribution in SHIPPED]


@pytest.mark.slow
@pytest.mark.parametrize("distribution", INSTALLED)
def test_everything_shipped_keeps_the_contract(distribution: str, capsys: pytest.CaptureFixture[str]) -> None:
    code = run_command(["check", distribution, "--quiet"])
    out = capsys.readouterr().out
    assert "\u2717" not in out, out
    assert code == 0, out
