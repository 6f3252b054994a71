"""Lights in packets: what a player has is what the text says, written here a second time; the background follows."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from packet_scenes import begin, decode_all, follow, make_light_packets, make_motion, same_bits, write_stream

from gsstream.core.changes import Delta, Light, apply_light, apply_motion, sendable_factor
from gsstream.core.errors import PacketError, ShapeError
from gsstream.packet import PlayerState, decode_delta, encode_delta
from gsstream.player.render import render

FACTORS = st.lists(st.floats(1 / 256, 256), min_size=3, max_size=3)


def behind(state: PlayerState, *colour: float) -> PlayerState:
    return replace(state, meta=replace(state.meta, background=colour))


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), FACTORS)
def test_a_player_has_what_the_text_says(seed: int, wanted: list[float]) -> None:
    rng = np.random.default_rng(seed)
    state = behind(begin(rng, 12, 5), *(float(v) for v in rng.random(3).astype(np.float32)))
    factor = sendable_factor(np.array(wanted))
    assert np.allclose(factor, wanted, rtol=2**-11)
    delta = Delta((Light(factor),))
    data = encode_delta(delta, state.layout, {}, frame=1).data
    assert len(data) == 27
    assert decode_delta(data, state.scene, {}).light == delta.light
    after = follow(state, delta)
    f = [np.float32(value) for value in factor]
    add = [np.float32((float(value) - 1) * 1.7724538509055159) for value in f]
    for row, values in enumerate(state.gaussians.sh0[:, 0].tolist()):
        for c, value in enumerate(values):
            assert after.gaussians.sh0[row, 0, c] == np.float32(np.float32(value) * f[c]) + add[c]
    for row in range(12):
        for basis in range(3):
            for c in range(3):
                assert after.gaussians.shN[row, basis, c] == state.gaussians.shN[row, basis, c] * f[c]
    assert [np.float32(b) for b in after.meta.background] == [
        np.float32(b) * f[c] for c, b in enumerate(state.meta.background)
    ]
    for name in ("means", "quats", "scales", "opacities"):
        assert getattr(after.gaussians, name) is getattr(state.gaussians, name)
    assert after.scene.displacement is None


def test_a_picture_is_so_many_times_as_bright() -> None:
    """Of colours below 1, which a picture does not cut off; the background is part of it."""
    state = behind(begin(np.random.default_rng(3), 60, 9), 0.4, 0.1, 0.2)
    dim = follow(state, Delta((Light((0.25, 0.5, 0.75)),)))
    for view in range(len(state.meta.test)):
        first, then = (render(s.gaussians, s.meta.test, view, background=s.meta.background) for s in (state, dim))
        np.testing.assert_allclose(then, first * np.array([0.25, 0.5, 0.75]), atol=2e-6)
        assert first.std() > 0.05


def test_motions_form_groups_by_what_the_light_leaves() -> None:
    rng = np.random.default_rng(4)
    state = begin(rng, 60, 9)
    light = Light((0.5, 0.5, 0.5))
    motion = make_motion(rng, apply_light(state.scene, light), predicted=False)
    after = follow(state, Delta((light, motion)))
    wanted = apply_motion(apply_light(state.scene, light), motion)[0]
    assert same_bits(after.gaussians, wanted.gaussians)
    assert after.scene.groups.group_of.tolist() == wanted.groups.group_of.tolist()
    assert after.scene.displacement is not None


def test_a_light_and_its_inverse_leave_next_to_nothing() -> None:
    state = begin(np.random.default_rng(5), 60, 9)
    there = follow(state, Delta((Light((16.0, 0.00390625, 2.0)),)))
    back = follow(there, Delta((Light((0.0625, 256.0, 0.5)),)))
    for name in ("sh0", "shN"):
        np.testing.assert_allclose(getattr(back.gaussians, name), getattr(state.gaussians, name), rtol=2e-6, atol=2e-6)


@pytest.mark.parametrize(
    "factor", [(0.0039, 1, 1), (1, 256.5, 1), (1, 1, 0), (1, 1, -1), (1.1, 1, 1), (1, 1), (np.nan,) * 3]
)
def test_what_cannot_be_sent_is_refused(factor: tuple[float, ...]) -> None:
    state = begin(np.random.default_rng(6), 10, 3)
    with pytest.raises(ShapeError, match="factor: expected"):
        encode_delta(Delta((Light(factor),)), state.layout, {}, frame=1)
    with pytest.raises(ShapeError, match="factor: expected"):
        apply_light(state.scene, Light(factor))


def test_a_background_beyond_float32_is_refused_and_the_state_stays() -> None:
    state = behind(begin(np.random.default_rng(7), 10, 3), 0.0, 1e38, 0.0)
    with pytest.raises(PacketError, match=r"background .* out of the range"):
        follow(state, Delta((Light((1.0, 8.0, 1.0)),)))


def test_the_browser_has_the_same_background(tmp_path: Path) -> None:
    """The hash of a frame has no background in it."""
    packets = make_light_packets(seed=8, number=20, nodes=6)
    path = tmp_path / "s.gss"
    write_stream(path, packets)
    wanted = [list(state.meta.background) for state in decode_all(packets)]
    script = Path(__file__).with_name("backgrounds.mjs")
    out = subprocess.run(["node", str(script), str(path)], capture_output=True, text=True, check=True, timeout=60)
    said = [[float(value) for value in line.split()] for line in out.stdout.splitlines()]
    assert said == wanted
    assert len({tuple(colour) for colour in wanted}) == 4
