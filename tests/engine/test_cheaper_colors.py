"""View-dependent colours of frame 0 rounded by what a bit buys: choices, extremes, and whole runs."""

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
from gsstream.engine.frame0.cheaper import _felt, chosen_codes
from gsstream.packet import EncodedPacket, decode_packet
from gsstream.packet.grids import KEY_BITS, color_codes, color_slopes, from_codes, to_codes


def drawn(seed: int, rows: int = 400, width: int = 6) -> tuple[np.ndarray, np.ndarray]:
    """Exact codes as of view-dependent colour, many small and few large, and what the images feel of them."""
    rng = np.random.default_rng(seed)
    return rng.laplace(scale=3, size=(rows, width)), 10 ** rng.uniform(-6, 2, (rows, width))


def cost(codes: np.ndarray, exact: np.ndarray, felt: np.ndarray, weight: float) -> float:
    """Squared error plus weight times the entropy of every column in bits."""
    total = float((felt * (codes - exact) ** 2).sum())
    for column in codes.T:
        counts = np.unique(column, return_counts=True)[1]
        total -= weight * float((counts * np.log2(counts / counts.sum())).sum())
    return total


def test_without_weight_every_code_is_the_nearest() -> None:
    exact, felt = drawn(0)
    assert np.array_equal(chosen_codes(exact, felt, 0.0), np.rint(exact))
    assert chosen_codes(exact, felt, 0.0).dtype == np.int32


@given(st.integers(0, 1000), st.floats(-6, 3))
def test_codes_cost_no_more_than_rounding_and_move_towards_zero(seed: int, exponent: float) -> None:
    exact, felt = drawn(seed)
    codes = chosen_codes(exact, felt, 10**exponent)
    nearest = np.rint(exact)
    assert cost(codes, exact, felt, 10**exponent) <= cost(nearest, exact, felt, 10**exponent) * (1 + 1e-9)
    assert np.all((np.abs(codes) <= np.abs(nearest)) & (codes * nearest >= 0))


@pytest.mark.parametrize("weight", [1e-30, 1e30])
def test_extremes(weight: float) -> None:
    exact, felt = drawn(3)
    codes = chosen_codes(exact, felt, weight)
    assert np.array_equal(codes, np.rint(exact) if weight < 1 else np.zeros_like(exact))


@pytest.mark.parametrize("exact", [np.zeros((5, 3)), np.full((1, 3), -4.4), np.zeros((0, 3)), np.zeros((4, 0))])
def test_odd_tables(exact: np.ndarray) -> None:
    assert np.array_equal(chosen_codes(exact, np.ones_like(exact), 1e-9), np.rint(exact))


def test_slopes_of_codes_are_those_of_finite_differences() -> None:
    rng = np.random.default_rng(1)
    values = rng.normal(size=(7, 8, 3)).astype(np.float32)
    weights = rng.normal(size=values.shape)
    slopes = color_slopes(weights, KEY_BITS["shN"])
    codes = to_codes("shN", values, KEY_BITS["shN"])
    for column in range(codes.shape[1]):
        more = codes.copy()
        more[:, column] += 1
        change = from_codes("shN", more, KEY_BITS["shN"]).astype(float) - from_codes("shN", codes, KEY_BITS["shN"])
        assert np.allclose((change * weights.reshape(7, -1)).sum(1), slopes[:, column], atol=1e-6)
    assert np.array_equal(np.rint(color_codes(values, KEY_BITS["shN"])), codes)


@cache
def key_packet(rate: float) -> tuple[EncodedPacket, Any]:
    with open_recording(WORLD) as source:
        made = encoder_for("s2gs-edge", source, {**TINY, "codec.key_rate": rate})
    step = made.encode(frames()[0])
    return step.packet, made


def test_a_run_has_a_smaller_key_packet_that_shows_nearly_the_same() -> None:
    plain, encoder = key_packet(0.0)
    cheap, _ = key_packet(3.0)
    sizes = [packet.sizes["shN"] for packet in (plain, cheap)]
    assert sizes[1] < 0.9 * sizes[0]
    errors = []
    for packet in (plain, cheap):
        scene = decode_packet(None, packet.data).gaussians.map(torch.from_numpy)
        error = 0.0
        for view in range(3):
            shown = encoder.parts.renderer.render(scene, frames()[0].cameras, view, (0.0, 0.0, 0.0)).image
            error += float((shown - torch.from_numpy(frames()[0].images[view])).square().mean())
        errors.append(error)
    assert errors[1] < 1.05 * errors[0]
    first, second = (decode_packet(None, packet.data).gaussians for packet in (plain, cheap))
    for name in ("means", "quats", "scales", "opacities", "sh0"):
        assert np.array_equal(getattr(first, name), getattr(second, name))


def test_what_is_felt_is_the_sum_of_squared_slopes() -> None:
    packet, encoder = key_packet(0.0)
    scene = decode_packet(None, packet.data).gaussians.map(torch.from_numpy)
    frame = frames()[0]
    felt = sum(_felt(encoder.parts, scene, frame, None, Rng(seed).stream("a", 0))[0] for seed in range(24)) / 24
    row, column = np.unravel_index(int(felt.argmax()), felt.shape)
    # One coefficient of one Gaussian, by two renders of every view.
    codes, images = color_codes(scene.shN.numpy(), KEY_BITS["shN"]), []
    for _ in range(2):
        shN = torch.from_numpy(from_codes("shN", codes, KEY_BITS["shN"])).reshape(scene.shN.shape)
        other = Gaussians(**{**dict(scene.items()), "shN": shN})
        images.append([encoder.parts.renderer.render(other, frame.cameras, v, (0.0, 0.0, 0.0)).image for v in range(3)])
        codes[row, column] += 1
    exact = sum(float((a - b).square().sum()) for a, b in zip(*images, strict=True))
    assert felt[row, column] == pytest.approx(exact, rel=0.5)
