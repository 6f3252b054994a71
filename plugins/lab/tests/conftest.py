"""Sweeps small enough to think through."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from gsstream_lab.sweep.config import read_sweep
from gsstream_lab.sweep.plan import Plan, make_plan

from gsstream.discovery.catalog import load_catalog


@pytest.fixture
def plan_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Plan]:
    """Text of a sweep's file -> plan, with the built-in methods alone."""
    monkeypatch.setenv("GSSTREAM_LOAD_PLUGINS", "lab")
    catalog = load_catalog()

    def make(text: str) -> Plan:
        path = tmp_path / "sweep.yaml"
        path.write_text(text, encoding="utf-8")
        return make_plan(read_sweep(path), tmp_path, catalog.recipe_path)

    return make
