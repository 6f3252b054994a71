"""What the plugin declares, its contract under other settings, its recipes, and the latent update rule."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from gsstream_s2gs.expected_sparsity import ExpectedSparsity
from gsstream_s2gs.gumbel_sigmoid import GumbelSigmoid
from gsstream_s2gs.latent import LatentCode, LatentResidual
from gsstream_s2gs.octree import StreamingOctree
from gsstream_s2gs.view_gradient import ViewSpaceGradient
from pydantic import ValidationError
from residual_oracle import train_rows
from s2gs_scene import gaussians

from gsstream.core.changes import Delta, Layout, Residual, Scene, apply_delta
from gsstream.core.gaussians import Gaussians
from gsstream.discovery.catalog import load_catalog
from gsstream.parts.update.base import init_latents
from gsstream.recipe.load import resolve_recipe
from gsstream.testing import parametrize_with_checks

KINDS = ("structure", "confidence", "propagation", "gate", "regularizer", "update")


@pytest.mark.parametrize(("name", "epochs"), [("s2gs", 20), ("s2gs-fast", 10), ("s2gs-edge", 6), ("s2gs-paper", 20)])
def test_budgets_of_the_paper(name: str, epochs: int) -> None:
    """And every slot of the paper's has one of these parts; its settings: tests/engine/test_assemble.py."""
    catalog = load_catalog()
    recipe = resolve_recipe(name, catalog.recipe_path).recipe
    assert recipe.method == name
    assert recipe.stream.epochs == epochs
    assert recipe.first_frame.epochs == 250
    assert recipe.growth.name == "none", "the paper's scene keeps its anchors"
    parts = [catalog.entries[kind, getattr(recipe, kind).name] for kind in KINDS]
    assert {part.distribution for part in parts} == {"gsstream-s2gs"}


class TestLatent:
    def test_sizes_are_the_released_ones(self) -> None:
        scene = gaussians(7)
        latents = init_latents(LatentResidual().codes(), scene)
        assert {n: v.shape[1] for n, v in latents.items()} == {
            "means": 3,
            "quats": 6,
            "scales": 8,
            "opacities": 1,
            "sh0": 4,
        }
        decoders = LatentResidual().init_decoders(scene, torch.Generator().manual_seed(0))
        assert {n: tuple(v.shape) for n, v in decoders.items()} == {
            "quats": (6, 4),
            "scales": (8, 3),
            "opacities": (1, 1),
            "sh0": (4, 3),
        }

    def test_one_number_may_be_changed(self) -> None:
        changed = LatentResidual.Config.model_validate({"sh0": {"lr": 0.05}, "means": {"step": 0.1}})
        assert changed.sh0 == LatentCode(latent=4, lr=0.05, decoder_std=0.01)
        assert changed.means.step == 0.1
        assert changed.means.lr == LatentResidual.Config().means.lr
        assert changed.quats == LatentResidual.Config().quats
        with pytest.raises(ValidationError, match=r"sh0\.rate"):
            LatentResidual.Config.model_validate({"sh0": {"rate": 0.05}})
        with pytest.raises(ValidationError, match="sh1"):
            LatentResidual.Config.model_validate({"sh1": {"lr": 0.05}})
        with pytest.raises(ValidationError, match="quats"):
            LatentResidual.Config.model_validate({"quats": 3})

    def test_rate_zero_freezes(self) -> None:
        frozen = LatentResidual(LatentResidual.Config.model_validate({"sh0": {"lr": 0.0}, "means": {"lr": 0.0}}))
        assert set(frozen.codes()) == {"quats", "scales", "opacities", "shN"}

    def test_a_closed_gate_keeps_its_bits_and_there_is_no_bias(self) -> None:
        scene, rule = gaussians(9), LatentResidual()
        generator = torch.Generator().manual_seed(0)
        decoders = rule.init_decoders(scene, generator)
        zeros = init_latents(rule.codes(), scene)
        latents = {n: 5 * torch.randn(v.shape, generator=generator) for n, v in zeros.items()}
        gates = torch.tensor([0.0] * 5 + [1.0] * 4)
        after = train_rows(rule, scene, gates, latents, decoders, torch.ones(9))
        silent = {n: torch.zeros_like(v) for n, v in latents.items()}
        same = train_rows(rule, scene, torch.ones(9), silent, decoders, torch.ones(9))
        for name, value in scene.items():
            assert torch.equal(getattr(after, name)[:5], value[:5])
            assert torch.equal(getattr(same, name), value)
            if name in latents:
                assert not torch.equal(getattr(after, name)[5:], value[5:])

    @pytest.mark.parametrize(
        ("name", "least", "most"),
        [
            # change of a visible quantity by one symbol: 8-bit grey levels, degrees, relative size, opacity at 0.5
            ("sh0", 0.2, 10.0),
            ("quats", 0.1, 5.0),
            ("scales", 0.002, 0.1),
            ("opacities", 0.0, 0.1),
        ],
    )
    def test_one_symbol_is_a_small_visible_change(self, name: str, least: float, most: float) -> None:
        scene, rule = gaussians(3), LatentResidual()
        seen = []
        for seed in range(20):
            decoder = rule.init_decoders(scene, torch.Generator().manual_seed(seed))[name]
            norm = float(decoder.norm(dim=1).mean())
            unit = {"sh0": 255 * 0.2821 / math.sqrt(3), "quats": math.degrees(2), "scales": 1.0, "opacities": 0.25}
            seen.append(norm * unit[name])
        mean = sum(seen) / len(seen)
        assert least < mean < most

    @pytest.mark.parametrize("views", [11, 17])
    def test_latents_speak_within_the_first_passes(self, views: int) -> None:
        """A steady gradient moves a symbol within two of the six passes of the shortest budget."""
        for name, code in LatentResidual().codes().items():
            if name in ("means", "shN"):
                continue
            latent = torch.zeros(400, requires_grad=True)
            adam = torch.optim.Adam([latent], lr=code.lr, eps=1e-15)
            for _ in range(2 * views):
                latent.grad = torch.ones_like(latent)
                adam.step()
            assert bool((latent.detach().abs() > 0.5).all()), name


ROWS = 400


def test_residuals_of_offset_and_factor_are_an_offset_to_half_a_symbol() -> None:
    """mu = h + o f, axis by axis, with residuals of both, through the packet's change and the plugin's step."""
    rng = np.random.default_rng(3)
    anchor, offset, more = (rng.normal(size=(ROWS, 3)) for _ in range(3))
    factor, wider = rng.lognormal(-2, 1, (ROWS, 3)), rng.lognormal(0, 0.3, (ROWS, 3))
    more[:100] = 0  # only the factor changes
    offset[:50] = 0  # and these lie at their anchors
    before, wanted = anchor + offset * factor, anchor + (offset + more) * (factor * wider)
    levels = rng.integers(0, 3, ROWS).astype(np.uint8)
    layout = Layout(np.ones(ROWS, np.int32), levels, np.array([0.2, 0.1, 0.05], np.float32))
    shapes = {"quats": (4,), "scales": (3,), "opacities": (), "sh0": (1, 3), "shN": (0, 3)}
    others = {name: np.zeros((ROWS, *shape), np.float32) for name, shape in shapes.items()}
    scene = Scene(Gaussians(means=before.astype(np.float32), **others), layout)
    step = LatentResidual().codes()["means"].step
    symbol = step * layout.units_of(np.arange(ROWS))[:, None]
    symbols = np.round((wanted - before) / symbol).astype(np.int32)
    residual = Residual(np.ones(ROWS, np.uint8), 1, {"means": symbols}, {"means": step})
    after = apply_delta(scene, Delta((residual,))).gaussians.means
    assert (np.abs(after - wanted) <= 0.5 * symbol + 1e-5).all()
    assert not symbols[:50].any(), "a factor moves nothing that lies at its anchor"
    assert symbols[50:100].any(axis=1).all()


Sparsity, Gate = ExpectedSparsity.Config, GumbelSigmoid.Config
Octree, Gradient = StreamingOctree.Config, ViewSpaceGradient.Config
RELEASED = Gradient(loss="l2norm", aggregate="sum-of-norms", normalisation="ratio")
#: Parts with settings other than their defaults; tests/contract/test_shipped_plugins.py checks the defaults.
PARTS = [
    StreamingOctree(Octree(gate_level=2)), StreamingOctree(Octree(grouping="gaussian")),
    ViewSpaceGradient(RELEASED), ViewSpaceGradient(Gradient(normalisation="minmax")),
    ViewSpaceGradient(Gradient(aggregate="mean-vector", normalisation="ratio")),
    ViewSpaceGradient(Gradient(aggregate="mean-of-norms", normalisation="ratio")),
    ViewSpaceGradient(Gradient(normalisation="noise")), ViewSpaceGradient(Gradient(epsilon_mode="relative")),
    GumbelSigmoid(Gate(levels=1)), GumbelSigmoid(Gate(noise="none")),
    GumbelSigmoid(Gate(levels=1, clamp_gradient=True)), GumbelSigmoid(Gate(levels=1, noise="gumbel")),
    GumbelSigmoid(Gate(noise="gumbel")), GumbelSigmoid(Gate(clamp_gradient=True)),
    GumbelSigmoid(Gate(noise="none", clamp_gradient=True)),
    ExpectedSparsity(Sparsity(reduction="sum", motion="half-mean")),
]  # fmt: skip


@parametrize_with_checks(PARTS)
def test_contract(check) -> None:
    check()
