"""The pattern of a residual: it costs no information, saves the zeros, and lies in it are refused."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from packet_scenes import make_delta, make_key, replaced

from gsstream.core.changes import Delta, Residual, Scene
from gsstream.core.errors import PacketError
from gsstream.packet import decode_delta, encode_delta
from gsstream.packet.symbols import encode_symbols


def scene(seed: int = 0) -> Scene:
    state = make_key(np.random.default_rng(seed), 40, 9)
    return Scene(state.gaussians, state.layout)


@given(st.integers(0, 2**32 - 1), st.floats(0, 1))
@settings(max_examples=40, deadline=None)
def test_every_table_comes_back_zeros_and_all(seed: int, share: float) -> None:
    rng, before = np.random.default_rng(seed), scene()
    gates = (rng.random(9) < 0.7).astype(np.uint8)
    rows = int(before.layout.node_counts[gates != 0].sum())
    widths = {"means": 3, "opacities": 1, "sh0": 3}
    symbols = {
        name: (rng.integers(-3, 4, (rows, width)) * (rng.random((rows, 1)) < share)).astype(np.int32)
        for name, width in widths.items()
    }
    residual = Residual(gates, 1, symbols, dict.fromkeys(widths, 0.5), {})
    packet = encode_delta(Delta().with_residual(residual), before.layout, {}, frame=1)
    found = decode_delta(packet.data, before, {}).residual
    assert found is not None
    for name in widths:
        np.testing.assert_array_equal(found.symbols[name], symbols[name], strict=True)


def test_rows_of_zeros_cost_next_to_nothing() -> None:
    """Nine attributes of ten rows that do not change: their zeros would cost more than all that changes."""
    rng = np.random.default_rng(1)
    state = make_key(rng, 4000, 9)
    symbols = {name: rng.integers(-8, 9, (4000, 3)).astype(np.int32) for name in ("means", "scales", "sh0")}
    kept = rng.random(4000) < 0.05
    for table in symbols.values():
        table[~kept] = 0
    residual = Residual(np.ones(9, np.uint8), 1, symbols, dict.fromkeys(symbols, 0.5), {})
    sizes = encode_delta(Delta().with_residual(residual), state.layout, {}, frame=1).sizes
    with_pattern = sum(sizes[name] for name in ("pattern", *symbols))
    assert with_pattern < 0.7 * sum(len(encode_symbols(table)) for table in symbols.values())


def test_a_pattern_that_asks_for_other_rows_than_are_there_is_refused() -> None:
    before = scene()
    delta = make_delta(np.random.default_rng(2), before.layout, 1.0, 1, latent=False)
    packet = encode_delta(delta, before.layout, {}, frame=1)
    rows = len(delta.residual.symbols["means"])
    with pytest.raises(PacketError):
        decode_delta(replaced(packet, "pattern", encode_symbols(np.zeros((rows, 1), np.int32))), before, {})
