"""The null parts, and the one map that encoder and player share."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError
from residual_oracle import apply_residual, decode_rows, train_rows

from gsstream.api import (
    ATTRIBUTES,
    Cameras,
    Delta,
    Gaussians,
    Hierarchy,
    Layout,
    PointCloud,
    Residual,
    Scene,
    apply_delta,
)
from gsstream.parts.confidence.uniform import Uniform
from gsstream.parts.gate.always_open import AlwaysOpen
from gsstream.parts.propagation.group_max import GroupMax
from gsstream.parts.residual.decode import add_joint, decode_joint, join_features, joint_vjp
from gsstream.parts.residual.layout import AttributeCode, joint_layout
from gsstream.parts.update.additive import Additive, DirectCode
from gsstream.parts.update.base import UpdateRule, init_latents, quantise_latents
from tests.scenes import make_scene


def rig() -> Cameras:
    return Cameras(("a",), np.eye(4)[None], np.array([[[50.0, 0, 8], [0, 50, 8], [0, 0, 1]]]), 16, 16)


def cloud(n: int, seed: int = 0) -> PointCloud:
    g = np.random.default_rng(seed)
    return PointCloud(g.normal(size=(n, 3)).astype(np.float32), g.random((n, 3)).astype(np.float32), "test")


class Coded(UpdateRule):
    """Latents for some attributes, identity for others; the shape S2GS has."""

    def codes(self) -> dict[str, AttributeCode]:
        return {
            "means": AttributeCode(step=0.02, lr=0.1),
            "quats": AttributeCode(step=1.0, lr=0.1, latent=6, decoder_std=0.1),
            "scales": AttributeCode(step=0.5, lr=0.1, latent=8, decoder_std=0.1),
            "opacities": AttributeCode(step=1.0, lr=0.1, latent=1, decoder_std=0.1),
            "sh0": AttributeCode(step=0.01, lr=0.1),
            "shN": AttributeCode(step=1.0, lr=0.1, latent=4, decoder_std=0.1),
        }


def test_different_settings_are_different_parts() -> None:
    assert Uniform(Uniform.Config(logit=1)) != Uniform()
    assert Uniform() != AlwaysOpen()


class TestGroupMax:
    """The contract kit says the rest: at least each member, no more than the largest, no other group."""

    def test_a_group_without_members_is_closed(self) -> None:
        index = torch.arange(3)
        hierarchy = Hierarchy(torch.tensor([0, 2, 0]), index, torch.zeros_like(index))
        assert GroupMax().propagate(torch.tensor([1.0, -7.0, 4.0]), hierarchy).tolist() == [4.0, -50.0, -7.0]

    def test_is_the_identity_on_the_flat_structure(self) -> None:
        logits = torch.tensor([3.0, -80.0, 0.0])  # below the value of an empty node, too
        index = torch.arange(3)
        hierarchy = Hierarchy(index, index, torch.zeros_like(index))
        assert torch.equal(GroupMax().propagate(logits, hierarchy), logits)


class TestAdditive:
    def test_rate_zero_freezes_an_attribute(self) -> None:
        rule = Additive(Additive.Config(shN=DirectCode(step=0.1, lr=0)))
        assert set(rule.codes()) == set(ATTRIBUTES) - {"shN"}
        assert rule.init_decoders(make_scene(3).map(torch.from_numpy), torch.Generator()) == {}

    @pytest.mark.parametrize("bad", [{"step": 0.0, "lr": 0.1}, {"step": 0.1, "lr": -1.0}])
    def test_impossible_codes_are_refused(self, bad: dict[str, float]) -> None:
        with pytest.raises(ValidationError):
            DirectCode(**bad)


class TestQuantise:
    @given(st.floats(-1e3, 1e3, width=32), st.sampled_from([1.0, 0.5, 0.02, 0.1, 1e-3]))
    @settings(max_examples=200, deadline=None)
    def test_the_value_is_what_the_decoder_computes(self, value: float, step: float) -> None:
        """Exactly symbol * step in float32, not an ulp beside it."""
        rule = Additive(Additive.Config(opacities=DirectCode(step=step, lr=1)))
        latents = {"opacities": torch.tensor([[value]], dtype=torch.float32)}
        base = make_scene(1).map(torch.from_numpy)
        _, change = decode_rows(rule, base, latents, {}, torch.ones(1))
        symbol = quantise_latents(rule.codes(), latents)["opacities"].numpy()
        assert np.array_equal(change.latents.numpy(), symbol.astype(np.float32) * np.float32(step))


def transmitted(
    rule: UpdateRule, scene: Gaussians[np.ndarray], seed: int, levels: int
) -> tuple[Gaussians[torch.Tensor], Gaussians[np.ndarray], np.ndarray]:
    """The same change by both paths: training forward on the active rows, and the player's on the whole scene."""
    g = np.random.default_rng(seed)
    counts = g.multinomial(len(scene), np.ones(7) / 7).astype(np.int32)
    layout = Layout(counts, g.integers(0, 3, len(scene)).astype(np.uint8), np.array([0.5, 0.3, 0.1], np.float32))
    gates = (g.integers(0, levels + 1, 7) * (g.random(7) < 0.7)).astype(np.uint8)
    gates[:1] = levels
    active = np.flatnonzero(gates[layout.node_of])
    base = scene.rows(active).map(torch.from_numpy)
    generator = torch.Generator().manual_seed(seed)
    latents = {
        name: 3 * rule.codes()[name].step * torch.randn(zero.shape, generator=generator)
        for name, zero in init_latents(rule.codes(), base).items()
    }
    decoders = rule.init_decoders(base, generator)
    gate = torch.from_numpy(gates[layout.node_of[active]].astype(np.float32)) / levels
    units = torch.from_numpy(layout.units_of(active))
    trained = train_rows(rule, base, gate, latents, decoders, units)
    residual = Residual(
        gates,
        levels,
        {name: value.numpy() for name, value in quantise_latents(rule.codes(), latents).items()},
        {name: code.step for name, code in rule.codes().items()},
        {name: value.numpy() for name, value in decoders.items()},
    )
    return trained, apply_delta(Scene(scene, layout), Delta((residual,))).gaussians, active


@pytest.mark.parametrize("rule", [Additive(), Coded()], ids=["additive", "coded"])
@pytest.mark.parametrize(("levels", "bases"), [(1, 1), (10, 9), (255, 16)])
def test_training_and_playing_compute_the_same_map(rule: UpdateRule, levels: int, bases: int) -> None:
    scene = make_scene(60, bases, seed=levels)
    trained, played, active = transmitted(rule, scene, seed=levels, levels=levels)
    for name in ATTRIBUTES:
        if bases == 1 and name == "shN":
            continue
        ours, theirs = getattr(trained, name).numpy(), getattr(played, name)[active]
        # float32: the decoder sums channel by channel, the product here in another order
        np.testing.assert_allclose(ours, theirs, rtol=2e-6, atol=2e-6, err_msg=name)
        assert not np.array_equal(theirs, getattr(scene, name)[active])
        rest = np.setdiff1d(np.arange(60), active)
        assert getattr(played, name)[rest].tobytes() == getattr(scene, name)[rest].tobytes()


def test_attributes_without_a_decoder_agree_to_a_rounding() -> None:
    """Training adds the gated change in one fused operation, the player in two: one rounding apart, no more."""
    scene = make_scene(80, 4, seed=5)
    trained, played, active = transmitted(Additive(), scene, seed=5, levels=10)
    for name in ATTRIBUTES:
        ours, theirs = getattr(trained, name).numpy(), getattr(played, name)[active]
        size = np.maximum(np.abs(theirs), np.abs(getattr(scene, name)[active]))
        assert (np.abs(ours - theirs) <= 2 * np.finfo(np.float32).eps * size).all(), name


def test_zero_latents_change_nothing() -> None:
    base = make_scene(9).map(torch.from_numpy)
    rule = Coded()
    latents, decoders = init_latents(rule.codes(), base), rule.init_decoders(base, torch.Generator().manual_seed(0))
    same = train_rows(rule, base, torch.ones(9), latents, decoders, torch.ones(9))
    assert all(torch.equal(getattr(same, n), getattr(base, n)) for n in ATTRIBUTES)


def test_latents_follow_width_and_degree() -> None:
    latents = init_latents(Coded().codes(), make_scene(5, bases=1).map(torch.from_numpy))
    assert {n: tuple(v.shape) for n, v in latents.items()} == {
        "means": (5, 3),
        "quats": (5, 6),
        "scales": (5, 8),
        "opacities": (5, 1),
        "sh0": (5, 3),
    }
    empty = init_latents(Coded().codes(), make_scene(0, bases=9).map(torch.from_numpy))
    assert tuple(empty["shN"].shape) == (0, 4)
    decoders = Coded().init_decoders(make_scene(0, bases=9).map(torch.from_numpy), torch.Generator().manual_seed(0))
    assert tuple(decoders["shN"].shape) == (4, 24)


def test_every_input_of_the_residual_feels_the_loss() -> None:
    base, rule = make_scene(6).map(torch.from_numpy), Coded()
    generator = torch.Generator().manual_seed(1)
    zeros = init_latents(rule.codes(), base)
    latents = {n: (2 * torch.randn(v.shape, generator=generator)).requires_grad_() for n, v in zeros.items()}
    decoders = {n: v.requires_grad_() for n, v in rule.init_decoders(base, generator).items()}
    gates = torch.full((6,), 0.5, requires_grad=True)
    out = apply_residual(rule, base, gates, latents, decoders, torch.ones(6))
    sum((value**2).sum() for _, value in out.items()).backward()
    for value in [gates, *latents.values(), *decoders.values()]:
        assert value.grad is not None
        assert torch.isfinite(value.grad).all()
        assert value.grad.abs().max() > 0


def test_written_out_gradient_equals_autograd() -> None:
    """The joint table is apply_residual and its gradient, with and without decoders, in every argument."""
    generator = torch.Generator().manual_seed(3)

    def draw(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    count = 7
    base = Gaussians(draw(count, 3), draw(count, 4), draw(count, 3), draw(count), draw(count, 1, 3), draw(count, 8, 3))
    rule = Additive()
    widths = {"means": 3, "quats": 4, "scales": 3, "opacities": 1, "sh0": 3, "shN": 24}
    decoders = {"quats": draw(6, 4).requires_grad_(), "shN": draw(4, 24).requires_grad_()}
    latents = {
        name: draw(count, decoders[name].shape[0] if name in decoders else width).requires_grad_()
        for name, width in widths.items()
    }
    gates, units = torch.rand(count, generator=generator, dtype=torch.float64).requires_grad_(), draw(count).abs()
    upstream = base.map(lambda value: draw(*value.shape))
    changed = apply_residual(rule, base, gates, latents, decoders, units)
    pairs = zip(changed.items(), upstream.items(), strict=True)
    sum((value * weight).sum() for (_, value), (_, weight) in pairs).backward()
    with torch.no_grad():
        code = joint_layout(rule.codes(), latents, decoders, base)
        joined, matrix = torch.cat(list(latents.values()), 1), code.join_decoders(decoders)
        change = decode_joint(code, joined, matrix, units)
        ours = add_joint(code, base, join_features(code, base), change, gates)
        back = joint_vjp(code, join_features(code, upstream), change, matrix, gates, units)
    for (name, value), (_, truth) in zip(ours.items(), changed.items(), strict=True):
        torch.testing.assert_close(value, truth, msg=name)
    torch.testing.assert_close(back.gates, gates.grad)
    by_latent, by_decoder = code.split(back.latents), code.split_decoders(back.matrix, decoders)
    for name, latent in latents.items():
        torch.testing.assert_close(by_latent[name], latent.grad)
    for name, decoder in decoders.items():
        torch.testing.assert_close(by_decoder[name], decoder.grad)
    # Nothing leaks into the blocks between attributes: there is nothing to train.
    assert not bool(back.matrix[code.trained == 0].any())


def test_joint_table_of_attributes_that_do_not_change() -> None:
    base = make_scene(4).map(torch.from_numpy)
    none = joint_layout(Additive().codes(), init_latents(Additive().codes(), base.rows(torch.arange(0))), {}, base)
    assert tuple(join_features(none, base.rows(torch.arange(0))).shape) == (0, none.trained.shape[1])
    code = joint_layout(Additive().codes(), {}, {}, base)
    change = decode_joint(code, torch.zeros(4, 0), code.join_decoders({}), torch.ones(4))
    same = add_joint(code, base, join_features(code, base), change, torch.ones(4))
    assert all(torch.equal(a, b) for (_, a), (_, b) in zip(same.items(), base.items(), strict=True))
