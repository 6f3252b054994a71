"""The stream at the limits of its numbers: refused in words, or decoded exactly.

Symbols at the ends of int32 and lone outliers, key grids, decoders beyond float16, damaged streams: tests/packet.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from gsstream_s2gs.latent import LatentResidual
from hypothesis import given
from hypothesis import strategies as st
from numeric_scenes import random_scene, some
from residual_oracle import decode_rows

from gsstream.core.changes import Delta, Layout, Residual, Scene
from gsstream.core.errors import PacketError, ShapeError
from gsstream.core.gaussians import Gaussians
from gsstream.packet import decode_delta, encode_delta, quantise_key
from gsstream.packet.grids import KEY_BITS, MAX_CODE, from_codes, to_codes
from gsstream.packet.symbols import MAX_BINS, decode_symbols, encode_symbols
from gsstream.parts.update.additive import Additive, DirectCode
from gsstream.parts.update.base import MAX_SYMBOL, quantise_latents


def layout(nodes: int = 6, rows: int = 2) -> Layout:
    levels = np.zeros(nodes * rows, np.uint8)
    return Layout(np.full(nodes, rows, np.int32), levels, np.array([0.5], np.float32))


@pytest.mark.parametrize("rule", [Additive(), LatentResidual()], ids=["additive", "latent"])
@pytest.mark.parametrize("bad", [math.nan, math.inf, -1e30, (MAX_SYMBOL + 2) * 100.0])
def test_latents_that_have_no_integer_are_refused(rule: Additive, bad: float) -> None:
    """Cast as they were, all of these became -2147483648, and that was sent."""
    latents = {"scales": torch.zeros(4, 3)}
    latents["scales"][2, 1] = bad
    with pytest.raises(ShapeError, match=r"latents of scales: .* row 2, channel 1 \(1 of 12 values\)"):
        quantise_latents(rule.codes(), latents)


@given(st.integers(-MAX_SYMBOL, MAX_SYMBOL), st.sampled_from([0.01, 0.02, 0.1, 0.25, 1.0]))
@some(80)
def test_every_symbol_up_to_the_limit_is_what_was_trained(symbol: int, step: float) -> None:
    """round(latent / step) of the trained value step * symbol gives symbol again, and the decoder its value."""
    latent = torch.tensor([[float(symbol)]]) * step
    rule = Additive(Additive.Config(opacities=DirectCode(step=step, lr=1)))
    base = Gaussians(*(torch.zeros(1, *shape) for shape in ((3,), (4,), (3,), (), (1, 3), (0, 3))))
    _, change = decode_rows(rule, base, {"opacities": latent}, {}, torch.ones(1))
    trained = change.latents
    sent = torch.round(trained / step).to(torch.int32)
    decoded = np.float32(int(sent)) * np.float32(step)
    assert float(decoded) == pytest.approx(float(trained), rel=2e-7, abs=0)
    if abs(symbol) < MAX_SYMBOL // 4:
        assert int(sent) == symbol


@pytest.mark.parametrize("spread", [1, MAX_BINS - 1, MAX_BINS, MAX_BINS + 1, 10 * MAX_BINS, 2**31])
def test_symbols_outside_the_modelled_range_escape(spread: int) -> None:
    column = np.concatenate([np.zeros(400), [spread - 1, -spread, spread // 2]]).astype(np.int64)
    table = column.clip(-(2**31), 2**31 - 1).astype(np.int32)[:, None]
    data = encode_symbols(table)
    assert np.array_equal(decode_symbols(data, *table.shape), table)
    assert len(data) < 120, "three outliers do not pay for the gap"


@pytest.mark.parametrize("name", ["scales", "opacities"])
def test_the_key_grid_holds_its_whole_range_and_refuses_the_first_value_beyond(name: str) -> None:
    bits = KEY_BITS[name]
    width = 3 if name == "scales" else 1
    largest = (MAX_CODE - 1) / 2.0**bits
    for value in (largest, -largest, 0.0, 2.0**-bits):
        table = np.full((2, width), value)
        assert np.array_equal(from_codes(name, to_codes(name, table, bits), bits), table)
    with pytest.raises(ShapeError, match=rf"{name}: expected values within .*; the optimisation has diverged"):
        to_codes(name, np.full((2, width), MAX_CODE / 2.0**bits), bits)


@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "sh0", "shN"])
@pytest.mark.parametrize("bad", [np.nan, np.inf, 3e38])
def test_a_key_packet_refuses_what_it_cannot_hold(name: str, bad: float) -> None:
    scene = random_scene(0, n=5).map(lambda value: value.numpy())
    getattr(scene, name).reshape(5, -1)[3, 0] = bad
    if name == "quats" and bad == 3e38:
        assert np.isfinite(quantise_key(scene).quats).all(), "a quaternion of any norm is a rotation"
        scene.quats[3], bad = 0.0, 0.0
    said = {0.0: "norm zero", 3e38: "diverged|below"}.get(bad, "finite")
    with pytest.raises(ShapeError, match=rf"{name}.*({said})"):
        quantise_key(scene)


def test_a_residual_that_would_leave_float32_is_refused_by_the_reader() -> None:
    residual = Residual(
        np.full(6, 10, np.uint8),
        10,
        {"scales": np.full((12, 1), 2**31 - 1, np.int32)},
        {"scales": 9e5},
        {"scales": np.full((1, 3), 65504, np.float32)},
    )
    scene = Scene(random_scene(0, n=12).map(lambda value: value.numpy()), layout())
    with pytest.raises(PacketError, match=r"a residual of .* cannot be"):
        decode_delta(encode_delta(Delta((residual,)), layout(), {}, frame=1).data, scene, {})
