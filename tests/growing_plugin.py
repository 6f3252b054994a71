"""A growth part for tests of whole runs, and how to have it installed: Gaussians are added, fitted, and leave."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import final

import numpy as np
import pytest
import torch
from distribution import write_metadata
from pydantic import Field

from gsstream.api import FitContext, Growth, PartConfig, Rng, RowEdit, Scene, add_as_nodes, add_to_nodes
from gsstream.blocks import fit_added
from gsstream.spec import ComponentSpec, hookimpl


@final
class CopyGrowth(Growth):
    """Copies Gaussians of what changed, in nodes that exist or in new ones, and removes the faintest."""

    source = "gsstream"

    class Config(PartConfig):
        per_frame: int = Field(default=24, ge=1, le=1000, description="Gaussians added in a frame, half as many go")

    def propose(self, after: Scene, work: FitContext, rng: Rng) -> RowEdit | None:
        changed = np.flatnonzero(work.changed_rows(0.5).numpy())
        number = min(self.config.per_frame, len(changed))
        if not number:
            return None
        generator = rng.numpy("copies", work.index)
        rows = np.sort(generator.choice(changed, number, replace=False))
        copies = after.gaussians.rows(rows)
        beside = generator.normal(0, 0.5, (number, 3)) * np.exp(copies.scales).mean(1, keepdims=True)
        copies = replace(copies, means=(copies.means + beside).astype(np.float32))
        scene, views = after.gaussians.map(torch.from_numpy), range(len(work.cameras))
        fitted = fit_added(scene, copies.map(torch.from_numpy), work, views, 1, rng).map(torch.Tensor.numpy)
        layout = after.layout
        units = layout.unit_of[rows]
        added = (
            add_to_nodes(fitted, layout.node_of[rows], units)
            if work.index % 2
            else add_as_nodes(fitted, units, len(layout.node_counts))
        )
        faintest = np.argsort(after.gaussians.opacities, kind="stable")[: number // 2]
        return RowEdit(added, np.sort(faintest))


@hookimpl
def gsstream_components() -> list[ComponentSpec]:
    return [ComponentSpec(kind="growth", name="neighbours", target="growing_plugin:CopyGrowth", summary="for tests")]


@contextmanager
def growth_installed(folder: Path) -> Iterator[None]:
    """In this process the part is installed as any plugin is: as the entry point of a distribution."""
    write_metadata(folder, "growing-plugin", "1.0", "[gsstream]\ngrowing = growing_plugin\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(folder))
        yield
