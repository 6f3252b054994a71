"""Which renderer a run gets on machines with and without a GPU, and what it says of it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
import torch

from gsstream.core.errors import InputError, PluginUnavailable, RecipeError
from gsstream.core.part import PartConfig, unwrapped
from gsstream.discovery.catalog import Catalog, load_catalog
from gsstream.engine.assembly.assemble import assemble
from gsstream.engine.assembly.choose_renderer import VARIABLE, choose_renderer
from gsstream.parts.backend.adam import ReferenceAdam
from gsstream.parts.backend.base import Renderer
from gsstream.parts.render.loss import ReferenceLoss
from gsstream.recipe.load import resolve_recipe

GPU = "NVIDIA GeForce RTX 4090"


class OnGpu(Renderer):
    """Stands in for the plugin's renderer; draws nothing."""

    source = "a test"

    class Config(PartConfig):
        device: str = "cuda"

    @property
    def device(self) -> torch.device:
        return torch.device(self.config.device)

    def render(self, gaussians: Any, cameras: Any, view: int, background: Any) -> Any:
        raise NotImplementedError


class Fails(Renderer):
    """A renderer whose kernels do not compile."""

    source = "a test"

    def __init__(self, config: PartConfig | None = None) -> None:
        raise PluginUnavailable("nvcc failed")

    def render(self, gaussians: Any, cameras: Any, view: int, background: Any) -> Any:
        raise NotImplementedError


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """A machine with one GPU that torch can use."""
    monkeypatch.delenv(VARIABLE, raising=False)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda *_: GPU)
    return monkeypatch


def with_gsplat(monkeypatch: pytest.MonkeyPatch, renderer: type[Renderer] | None) -> Catalog:
    """The installed catalogue, in which the renderer ``gsplat`` is this class; None: there is none."""
    catalog, resolve = load_catalog(), Catalog.resolve

    def resolved(self: Catalog, kind: str, name: str) -> Any:
        if (kind, name) != ("renderer", "gsplat"):
            return resolve(self, kind, name)
        return resolve(self, kind, "no-such-renderer") if renderer is None else renderer

    monkeypatch.setattr(Catalog, "resolve", resolved)
    return catalog


def assembled(catalog: Catalog, *settings: str) -> Any:
    changes = [("--set", text) for text in settings]
    return assemble(resolve_recipe("s2gs", catalog.recipe_path, (), changes), catalog)


def test_a_gpu_is_used_and_named(machine: pytest.MonkeyPatch) -> None:
    parts = assembled(with_gsplat(machine, OnGpu))
    assert parts.recipe.renderer.name == "gsplat"
    assert parts.note.startswith(f"rendering on {GPU} with gsplat")
    assert type(unwrapped(parts.renderer.loss)) is ReferenceLoss, "the defaults work where the renderer does"
    assert type(unwrapped(parts.renderer.optimiser)) is ReferenceAdam


@pytest.mark.parametrize(
    ("renderer", "says"),
    [(Fails, rf"{GPU} is not used: .*nvcc failed"), (None, rf"{GPU} is not used: .*pip install")],
)
def test_a_gpu_that_cannot_be_used_is_named_with_the_reason(
    machine: pytest.MonkeyPatch, renderer: type[Renderer] | None, says: str
) -> None:
    parts = assembled(with_gsplat(machine, renderer))
    assert parts.recipe.renderer.name == "cpu"
    assert re.match(says, parts.note), parts.note


@pytest.mark.parametrize("method", ["queen", "quarc", "comgs-s", "stream3dgs"])
def test_a_method_of_the_processor_stays_there_and_says_why(machine: pytest.MonkeyPatch, method: str) -> None:
    catalog = with_gsplat(machine, OnGpu)
    parts = assemble(resolve_recipe(method, catalog.recipe_path, (), ()), catalog)
    assert parts.recipe.renderer.name == "cpu"
    assert re.match(rf"{GPU} is not used: \w+ \w+: .*numpy", parts.note), parts.note
    with pytest.raises(RecipeError, match=r"'gsplat' works on a GPU, and \w+ \w+: .*numpy; choose --renderer cpu"):
        assemble(resolve_recipe(method, catalog.recipe_path, (), [("--set", "renderer=gsplat")]), catalog)


def test_torch_without_cuda_is_named_where_a_driver_is(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    driver = tmp_path / "nvidia-smi"
    driver.write_text("#!/bin/sh\n")
    driver.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    chosen = choose_renderer(load_catalog())
    assert chosen.name == "cpu"
    assert "the NVIDIA GPU is not used: torch" in chosen.note
    assert "pip install" in chosen.note


@pytest.mark.parametrize("setting", ["renderer=cpu", None])
def test_a_gpu_can_be_declined(machine: pytest.MonkeyPatch, setting: str | None) -> None:
    catalog = with_gsplat(machine, OnGpu)
    if setting is None:
        machine.setenv(VARIABLE, "cpu")
    parts = assembled(catalog, *([setting] if setting else []))
    assert (parts.recipe.renderer.name, parts.note) == ("cpu", "")


def test_a_gpu_that_is_asked_for_is_used_or_the_run_ends(machine: pytest.MonkeyPatch) -> None:
    machine.setenv(VARIABLE, "cuda:1")
    chosen = choose_renderer(with_gsplat(machine, OnGpu))
    assert str(chosen.renderer.device) == "cuda:1"  # type: ignore[attr-defined]
    machine.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(PluginUnavailable, match=f"{VARIABLE}=cuda:1: "):
        choose_renderer(load_catalog())
    machine.setenv(VARIABLE, "gpu")
    with pytest.raises(InputError, match="expected auto, cpu, cuda or cuda:N, got 'gpu'"):
        choose_renderer(load_catalog())
