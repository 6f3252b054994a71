"""Frame 0 rounded by what a bit buys: choices, extremes, sensitivities, and whole runs."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from test_encoder import TINY, WORLD, frames

from gsstream.core.gaussians import Gaussians
from gsstream.core.rng import Rng
from gsstream.encode import encoder_for, open_recording
from gsstream.engine.frame0.rd_quantise import REACH, code_sensitivity, rd_quantise
from gsstream.engine.frame0.rounding import rd_codes_nearby, rd_codes_to_zero
from gsstream.packet import EncodedPacket, decode_packet
from gsstream.packet.grids import KEY_BITS, color_codes, color_grads, from_codes, to_codes


def drawn(seed: int, rows: int = 400, width: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """Exact codes as of view-dependent colour, many small and few large, and what the images feel of them."""
    rng = np.random.default_rng(seed)
    return rng.laplace(scale=3, size=(rows, width)), 10 ** rng.uniform(-6, 2, (rows, width))


def cost(codes: np.ndarray, exact: np.ndarray, sensitivity: np.ndarray, weight: float) -> float:
    """Squared error plus weight times the entropy of every column in bits."""
    total = float((sensitivity * (codes - exact) ** 2).sum())
    for column in codes.T:
        counts = np.unique(column, return_counts=True)[1]
        total -= weight * float((counts * np.log2(counts / counts.sum())).sum())
    return total


def test_without_weight_every_code_is_the_nearest() -> None:
    exact, sensitivity = drawn(0)
    for codes in (rd_codes_to_zero(exact, sensitivity, 0.0), rd_codes_nearby(exact, sensitivity, 0.0, 5)):
        assert np.array_equal(codes, np.rint(exact))
        assert codes.dtype == np.int32


@given(st.integers(0, 1000), st.floats(-6, 3))
def test_codes_cost_no_more_than_rounding_and_move_towards_zero(seed: int, exponent: float) -> None:
    exact, sensitivity = drawn(seed)
    codes = rd_codes_to_zero(exact, sensitivity, 10**exponent)
    nearest = np.rint(exact)
    assert cost(codes, exact, sensitivity, 10**exponent) <= cost(nearest, exact, sensitivity, 10**exponent) * (1 + 1e-9)
    assert np.all((np.abs(codes) <= np.abs(nearest)) & (codes * nearest >= 0))


@given(st.integers(0, 1000), st.floats(-6, 3), st.integers(0, 9))
def test_codes_nearby_cost_no_more_and_stay_within_reach(seed: int, exponent: float, reach: int) -> None:
    exact, sensitivity = drawn(seed)
    codes = rd_codes_nearby(exact - 40, sensitivity, 10**exponent, reach)
    nearest = np.rint(exact - 40)
    found, plain = (cost(each, exact - 40, sensitivity, 10**exponent) for each in (codes, nearest))
    assert found <= plain * (1 + 1e-9)
    assert int(np.abs(codes - nearest).max()) <= reach


@pytest.mark.parametrize("weight", [1e-30, 1e30])
def test_extremes(weight: float) -> None:
    exact, sensitivity = drawn(3)
    codes = rd_codes_to_zero(exact, sensitivity, weight)
    assert np.array_equal(codes, np.rint(exact) if weight < 1 else np.zeros_like(exact))
    near = rd_codes_nearby(exact, sensitivity, weight, 3)
    assert np.array_equal(near, np.rint(exact)) if weight < 1 else int(np.abs(near - exact).max()) <= 3


@pytest.mark.parametrize("exact", [np.zeros((5, 3)), np.full((1, 3), -4.4), np.zeros((0, 3)), np.zeros((4, 0))])
def test_odd_tables(exact: np.ndarray) -> None:
    for codes in (rd_codes_to_zero(exact, np.ones_like(exact), 1e-9), rd_codes_nearby(exact, exact + 9, 1e-9, 4)):
        assert np.array_equal(codes, np.rint(exact))


def test_gradients_of_codes_are_those_of_finite_differences() -> None:
    rng = np.random.default_rng(1)
    values = rng.normal(size=(7, 8, 3)).astype(np.float32)
    weights = rng.normal(size=values.shape)
    grads = color_grads(weights, KEY_BITS["shN"])
    codes = to_codes("shN", values, KEY_BITS["shN"])
    for column in range(codes.shape[1]):
        more = codes.copy()
        more[:, column] += 1
        change = from_codes("shN", more, KEY_BITS["shN"]).astype(float) - from_codes("shN", codes, KEY_BITS["shN"])
        assert np.allclose((change * weights.reshape(7, -1)).sum(1), grads[:, column], atol=1e-6)
    assert np.array_equal(np.rint(color_codes(values, KEY_BITS["shN"])), codes)


@cache
def key_packet(rate: float) -> tuple[EncodedPacket, Any]:
    with open_recording(WORLD) as source:
        made = encoder_for("s2gs-edge", source, {**TINY, "codec.key_rd_lambda": rate, "codec.first_layer": 1})
    step = made.encode(frames()[0])
    return step.packet, made


def scene_of(packet: EncodedPacket) -> Gaussians[np.ndarray]:
    return decode_packet(None, packet.data).gaussians


def test_a_run_has_a_smaller_key_packet_that_shows_nearly_the_same() -> None:
    plain, encoder = key_packet(0.0)
    cheap, _ = key_packet(1.0)
    for name in KEY_BITS:
        assert cheap.sizes[name] < plain.sizes[name], name
    errors = []
    for packet in (plain, cheap):
        scene = scene_of(packet).map(torch.from_numpy)
        error = 0.0
        for view in range(3):
            shown = encoder.assembly.renderer.render(
                scene, frames()[0].cameras, view, encoder.assembly.background
            ).image
            error += float((shown - torch.from_numpy(frames()[0].images[view])).square().mean())
        errors.append(error)
    assert errors[1] < 1.3 * errors[0]


def test_what_moves_stays_within_reach() -> None:
    """At any rate: other cameras may feel what the training cameras do not."""
    packet, _ = key_packet(0.0)
    scene, codes = scene_of(packet).map(torch.from_numpy), []
    for rate in (0.0, 1e6):
        parts, rng = key_packet(rate)[1].assembly, Rng(0)
        found = rd_quantise(parts, scene, frames()[0], None, rng)
        assert torch.equal(found.means, scene.means)
        codes.append({name: to_codes(name, getattr(found, name).numpy(), bits) for name, bits in KEY_BITS.items()})
    for name, reach in REACH.items():
        # The first component of a quaternion follows from the three others.
        one, other = (found[name][:, 1:] if name == "quats" else found[name] for found in codes)
        assert 0 < int(np.abs(one - other).max()) <= reach, name
    assert not codes[1]["shN"].any()


@pytest.mark.parametrize("name", sorted(KEY_BITS))
def test_sensitivity_is_what_a_code_changes(name: str) -> None:
    """Of the code with the largest sensitivity of every attribute, by two renders of every view."""
    packet, encoder = key_packet(0.0)
    scene, frame = scene_of(packet).map(torch.from_numpy), frames()[0]
    sensitivity = sum(
        code_sensitivity(encoder.assembly, scene, frame, None, Rng(seed).stream("a", 0))[0][name] for seed in range(24)
    )
    sensitivity = sensitivity / 24
    row, column = np.unravel_index(int(sensitivity.argmax()), sensitivity.shape)
    bits = KEY_BITS[name]
    flat = getattr(scene, name).numpy().reshape(len(scene), -1)
    images, behind = [], encoder.assembly.background
    for shift in (-0.5, 0.5):
        if name.startswith("sh"):
            codes = color_codes(flat, bits)
            codes[row, column] += shift
            values = from_codes(name, codes, bits)
        else:
            values = flat.copy()
            values[row, column] += shift * 2.0**-bits
        other = Gaussians(**{**dict(scene.items()), name: torch.from_numpy(values).reshape(getattr(scene, name).shape)})
        images.append([encoder.assembly.renderer.render(other, frame.cameras, v, behind).image for v in range(3)])
    exact = sum(float((a - b).square().sum()) for a, b in zip(*images, strict=True))
    assert sensitivity[row, column] == pytest.approx(exact, rel=0.5)


def test_a_scene_without_gaussians_stays_one() -> None:
    """A refinement of a few iterations may prune everything: it was refused with an error of numpy's."""
    packet, encoder = key_packet(0.1)
    scene = scene_of(packet).map(torch.from_numpy).rows(torch.zeros(0, dtype=torch.int64))
    assert len(rd_quantise(encoder.assembly, scene, frames()[0], None, Rng(0))) == 0
