"""Packets that must fit: real bytes, decodable, the least useful first, and nothing touched that fits already."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from gsstream.core.changes import Delta, Layout, Motion, Residual, RowEdit, Scene, add_as_nodes, sent_rows
from gsstream.core.gaussians import Gaussians
from gsstream.engine.budget.trim import _GATE_BITS, _Table, trim_to_size
from gsstream.packet import EncodedPacket, encode_delta, encode_empty, quantise_decoders
from gsstream.packet.delta import decode_delta

NODES = 120


def scene(seed: int, *, spread: float = 4.0, share: float = 0.7, births: int = 0) -> tuple[Delta, dict, Layout]:
    """A delta of about 120 nodes, and a curvature."""
    g = np.random.default_rng(seed)
    counts = g.integers(1, 5, NODES).astype(np.int32)
    layout = Layout(counts, g.integers(0, 3, counts.sum()).astype(np.uint8), np.array([0.5, 0.3, 0.1], np.float32))
    gates = (g.integers(1, 11, NODES) * (g.random(NODES) < share)).astype(np.uint8)
    rows = len(sent_rows(layout, gates))
    widths = {"means": 3, "quats": 6, "sh0": 4}
    symbols = {name: np.rint(g.laplace(0, spread, (rows, w))).astype(np.int32) for name, w in widths.items()}
    symbols = {name: value for name, value in symbols.items() if value.any()}
    shapes = {"quats": (6, 4), "sh0": (4, 3)}
    decoders = {n: g.normal(size=shapes[n]).astype(np.float32) for n in shapes if n in symbols}
    added = None
    if births:
        colour = Gaussians(
            means=g.normal(size=(births, 3)),
            quats=g.normal(size=(births, 4)),
            scales=g.normal(size=(births, 3)),
            opacities=g.normal(size=births),
            sh0=g.normal(size=(births, 1, 3)),
            shN=np.zeros((births, 0, 3)),
        ).map(lambda value: np.asarray(value, np.float32))
        added = add_as_nodes(colour, np.zeros(births, np.uint8), NODES)
    residual = Residual(gates, 10, symbols, dict.fromkeys(symbols, 0.5), quantise_decoders(decoders))
    delta = Delta((residual,)).with_row_edit(RowEdit(added))
    curvature = {name: g.exponential(size=value.shape) for name, value in symbols.items()}
    return delta, curvature, layout


def rows_of(layout: Layout) -> Gaussians:
    """As many Gaussians as the layout has; what they are matters to no residual."""
    number = len(layout.unit_of)
    shapes = {"means": (3,), "quats": (4,), "scales": (3,), "opacities": (), "sh0": (1, 3), "shN": (0, 3)}
    return Gaussians(**{name: np.zeros((number, *shape), np.float32) for name, shape in shapes.items()})


def encoder(layout: Layout):
    def encode(delta: Delta) -> EncodedPacket:
        return encode_empty(frame=3) if delta.is_empty else encode_delta(delta, layout, {}, frame=3)

    return encode


@given(st.integers(0, 10_000), st.floats(0.01, 1.5), st.sampled_from([0.05, 1.0, 20.0]), st.booleans())
@settings(max_examples=30)
def test_a_packet_never_exceeds_a_feasible_size(seed: int, share: float, spread: float, births: bool) -> None:
    delta, curvature, layout = scene(seed, spread=spread, births=5 * births)
    encode = encoder(layout)
    whole = len(encode(delta).data)
    limit = max(16, int(share * whole))
    fitted = trim_to_size(delta, encode(delta), curvature, layout, encode, limit)
    assert len(fitted.packet.data) <= limit
    assert fitted.untrimmed == whole
    if whole <= limit:
        assert fitted.delta is delta
        assert fitted.given_up() == {"symbols": 0, "gates": 0, "added": 0}
        return
    assert sum(fitted.given_up().values()) > 0
    if fitted.delta.is_empty:
        return
    # What was decided is what is sent: the packet decodes to it.
    decoded, sent = decode_delta(fitted.packet.data, Scene(rows_of(layout), layout), {}).residual, fitted.delta.residual
    np.testing.assert_array_equal(decoded.gates, sent.gates)
    assert set(decoded.symbols) == set(sent.symbols)
    for name, value in sent.symbols.items():
        np.testing.assert_array_equal(decoded.symbols[name], value)
    # Only towards zero, and no gate opens.
    asked = delta.residual
    assert not np.any(sent.gates[asked.gates == 0])
    before, after = (sent_rows(layout, residual.gates) for residual in (asked, sent))
    for name, value in sent.symbols.items():
        old = asked.symbols[name][np.searchsorted(before, after)]
        assert np.all((np.abs(value) <= np.abs(old)) & (value * old >= 0))


@pytest.mark.parametrize("seed", range(5))
def test_the_limit_is_nearly_used(seed: int) -> None:
    delta, curvature, layout = scene(seed)
    encode = encoder(layout)
    for share in (0.9, 0.6, 0.35):
        limit = int(share * len(encode(delta).data))
        assert len(trim_to_size(delta, encode(delta), curvature, layout, encode, limit).packet.data) >= 0.85 * limit


@pytest.mark.parametrize("seed", range(5))
def test_what_matters_stays(seed: int) -> None:
    """Half of the gates carry a thousand times the curvature of the others: they must outlive them."""
    delta, curvature, layout = scene(seed)
    opened = np.flatnonzero(delta.residual.gates)
    dear = np.repeat(np.arange(len(opened)) % 2 == 0, layout.node_counts[opened])
    curvature = {name: value * np.where(dear, 1000.0, 1.0)[:, None] for name, value in curvature.items()}
    encode = encoder(layout)
    fitted = trim_to_size(delta, encode(delta), curvature, layout, encode, int(0.5 * len(encode(delta).data)))
    kept = fitted.delta.residual.gates[opened] != 0
    assert kept[0::2].mean() > 0.8
    assert kept[1::2].mean() < 0.1


def test_births_go_when_nothing_else_helps() -> None:
    delta, curvature, layout = scene(1, births=40)
    encode = encoder(layout)
    plain = trim_to_size(delta, encode(delta), curvature, layout, encode, 400)
    assert plain.delta.added is None
    assert plain.given_up()["added"] == 40
    assert len(plain.packet.data) <= 400


def test_a_motion_stays_while_symbols_go_and_goes_last_of_all() -> None:
    """What carries a body along costs little and is worth much: the symbols behind gates pay first."""
    delta, curvature, layout = scene(4)
    motion = Motion(0.5, 1, np.array([1, 0, 1], np.uint8), np.full((2, 6), 3, np.int32), 0.25, 0.25)
    delta = Delta((motion, *delta.changes))
    encode = encoder(layout)
    fitted = trim_to_size(delta, encode(delta), curvature, layout, encode, len(encode(delta).data) // 2)
    assert fitted.delta.motions == (motion,)
    assert fitted.given_up()["symbols"] > 0
    assert trim_to_size(delta, encode(delta), curvature, layout, encode, 16).delta.is_empty


def test_an_empty_packet_is_the_last_resort() -> None:
    delta, curvature, layout = scene(2)
    encode = encoder(layout)
    fitted = trim_to_size(delta, encode(delta), curvature, layout, encode, 16)
    assert fitted.delta.is_empty
    assert len(fitted.packet.data) == 16
    assert fitted.given_up()["gates"] == np.count_nonzero(delta.residual.gates)


@given(st.integers(0, 10_000), st.sampled_from([0.05, 1.0, 20.0]), st.floats(1e-6, 1e3))
@settings(max_examples=10)
def test_leaving_zeros_out_of_the_choice_changes_nothing(seed: int, spread: float, price: float) -> None:
    """Against all symbols of all rows weighed one by one."""
    delta, curvature, layout = scene(seed, spread=spread)
    residual = delta.residual
    assume(residual.symbols)
    table = _Table(residual, curvature, layout)
    values, opened, bits = table._choose(price)
    kept = np.zeros_like(table.symbols)
    kept[table.place] = values
    wanted, lost, code, shut = np.zeros_like(kept), *np.zeros((3, *kept.shape))
    worth = np.concatenate([curvature[n] * residual.steps[n] ** 2 for n in residual.symbols], 1)
    for channel, column in enumerate(table.symbols.T):
        for row, symbol in enumerate(column):
            choices = []
            for value in (symbol, symbol - np.sign(symbol), 0):
                length = np.log2(len(column) / max(np.sum(column == value), 0.5))
                choices.append((worth[row, channel] * (value - symbol) ** 2, length, value))
            best = min(choices, key=lambda c: c[0] + price * c[1])
            lost[row, channel], code[row, channel], wanted[row, channel] = best
            shut[row, channel] = choices[2][0]
    np.testing.assert_array_equal(kept, wanted)
    gate = np.repeat(np.arange(len(table.counts)), table.counts)
    cost, length, closed = (np.bincount(gate, part.sum(1), len(opened)) for part in (lost, code, shut))
    np.testing.assert_array_equal(opened, closed > cost + price * (length + _GATE_BITS))
    assert bits == pytest.approx((length + _GATE_BITS)[opened].sum())
