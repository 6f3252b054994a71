"""All that this repository ships keeps the contract, by default and under settings that matter to it.

What a part cannot keep, it denies with a reason.
"""

from __future__ import annotations

from typing import Any

import pytest

from gsstream.cli.main import run_command
from gsstream.discovery.catalog import load_catalog
from gsstream.testing.kit import run_checks
from gsstream.testing.method_driver import around

SHIPPED = {
    "gsstream": "builtin", "gsstream-s2gs": "s2gs", "gsstream-queen": "queen", "gsstream-cpu-render": "cpu",
    "gsstream-gsplat-render": "gsplat", "gsstream-ft-pruning": "ft-pruning", "gsstream-binary-ste": "binary-ste",
    "gsstream-onnx-confidence": "onnx", "gsstream-hicom": "hicom", "gsstream-comgs": "comgs",
    "gsstream-stream3dgs": "stream3dgs", "gsstream-recon": "recon", "gsstream-quarc": "quarc",
    "gsstream-lab": "lab", "gsstream-capture": "capture",
}  # fmt: skip
INSTALLED = [plugin.distribution for plugin in load_catalog().plugins if plugin.distribution in SHIPPED]


@pytest.mark.slow
@pytest.mark.parametrize("distribution", INSTALLED)
def test_everything_shipped_keeps_the_contract(distribution: str, capsys: pytest.CaptureFixture[str]) -> None:
    code = run_command(["check", distribution, "--quiet"])
    out = capsys.readouterr().out
    assert "\u2717" not in out, out
    assert code == 0, out


COPIES = {"epochs": 1, "gradient": 1e-6, "rounds": 1, "most": 9}
ANCHORS = {"measure": "anchor", "step": 0.02, "rotation_step": 0.002}
CACHE = {"epochs": 1, "levels": 4, "entries": 8, "width": 8, "lr": 0.02, "box": 0.0}
#: Whole method -> settings under which something moves, and is born, in three frames of one or two passes.
EAGER: dict[str, list[dict[str, Any]]] = {
    "queen": [
        {},
        {
            "growth": {"every": 1, "start": 0, "stop": 1, "grad_threshold": 1e-6, "max_added": 20},
            "rows": "dynamic",
            "change": {"dynamic": 1e-8},
            "rate": 1e-3,
            "sigma": 1e-4,
        },
    ],
}
#: Part of a slot -> settings, beside the default, of which each changes what it does.
OTHERWISE: dict[tuple[str, str], list[dict[str, Any]]] = {
    ("gate", "binary-ste"): [{"noise": "none"}, {"temperature": 2.0}, {"clamp_gradient": True}],
    ("motion", "keypoints"): [{"keypoints": 20, "step": 0.02}],
    ("motion", "hicom"): [{"epochs": 1, "measure": "cell", "step": 0.02}, {"momentum": 0.0}],
    ("motion", "recon"): [ANCHORS, {**ANCHORS, "rounded": True}, {"every": 1}, {"momentum": 0.0}],
    ("motion", "stream3dgs"): [CACHE, {**CACHE, "sent": "cells"}],
    ("growth", "copies"): [COPIES, {**COPIES, "leave": "last-added"}],
    ("growth", "change-gated-copies"): [{**COPIES, "score": 0.1}],
    ("update", "additive"): [{"every": 2}],
    ("propagation", "ft-pruning"): [{"tau": tau} for tau in (0.5, 0.8, 0.9, 0.95)],
}
ROWS = [(("streaming_method", name), settings) for name, rows in EAGER.items() for settings in rows]
ROWS += [(slot, settings) for slot, rows in OTHERWISE.items() for settings in rows]
FOUND = load_catalog().entries


@pytest.mark.parametrize(("slot", "settings"), [pytest.param(*row, id=row[0][1]) for row in ROWS if row[0] in FOUND])
def test_under_settings_that_matter_it_keeps_the_contract(slot: tuple[str, str], settings: dict[str, Any]) -> None:
    target = load_catalog().resolve(*slot)
    part = target(target.Config.model_validate(settings))
    assert [f"{result.check}: {result.message}" for result in run_checks(part) if not result.ok] == []
    if slot[0] == "streaming_method":
        assert "delta" in [step.status for step in around(part).steps], "nothing happened: the checks prove too little"
