"""Key packets in two layers: the same scene, and a first picture of it before the last byte."""

from __future__ import annotations

import struct
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from packet_scenes import make_key, replaced, same_bits

from gsstream.core.errors import PacketError, ShapeError
from gsstream.packet import decode_key, encode_key, first_layer, quantise_key
from gsstream.packet.base import PACKET_HEADER, build_packet, parse_packet
from gsstream.packet.tables import coded_tables

SEEDS = st.integers(0, 2**32 - 1)


def make_layers(seed: int = 1, number: int = 60, share: float = 0.5, sh_rest: int = 3):
    """A key's state, which of its Gaussians come first, and the packet."""
    rng = np.random.default_rng(seed)
    state = make_key(rng, number, sh_rest=sh_rest)
    first = rng.random(number) < share
    return state, first, encode_key(state, frame=5, first=first)


def bytes_needed(packet) -> int:
    return len(packet.data) - packet.sizes["rest"] - packet.sizes["layout"] - 10


@settings(max_examples=60, deadline=None)
@given(SEEDS, st.integers(0, 60), st.sampled_from([0.0, 0.1, 0.5, 0.95, 1.0]), st.sampled_from([0, 3, 8, 15]))
def test_layers_do_not_show_in_the_decoded_scene(seed, number, share, sh_rest):
    state, first, packet = make_layers(seed, number, share, sh_rest)
    plain, layered = decode_key(encode_key(state, frame=5).data), decode_key(packet.data)
    assert same_bits(layered.gaussians, plain.gaussians)
    assert same_bits(layered.gaussians, quantise_key(state.gaussians))
    assert layered.layout.node_counts.tobytes() == plain.layout.node_counts.tobytes()
    assert layered.layout.unit_of.tobytes() == plain.layout.unit_of.tobytes()
    assert layered.meta.recipe_hash == plain.meta.recipe_hash
    assert encode_key(layered, frame=5, first=first).data == packet.data
    assert sum(packet.sizes.values()) == len(packet.data)


@settings(max_examples=40, deadline=None)
@given(SEEDS, st.integers(0, 60), st.sampled_from([0.0, 0.3, 1.0]))
def test_the_first_layer_is_there_as_soon_as_its_bytes_are(seed, number, share):
    state, first, packet = make_layers(seed, number, share)
    needed = bytes_needed(packet)
    found = first_layer(packet.data[:needed])
    assert found is not None
    assert same_bits(found.gaussians, quantise_key(state.gaussians).rows(np.flatnonzero(first)))
    assert found.frame == 5
    assert found.meta.camera("left").near_plane == 0.02


def test_every_cut_gives_nothing_or_the_first_layer():
    state, first, packet = make_layers()
    needed, expected = bytes_needed(packet), quantise_key(state.gaussians).rows(np.flatnonzero(first))
    assert 0.3 * len(packet.data) < needed < 0.8 * len(packet.data)
    ends = [0, PACKET_HEADER.size, *np.cumsum([0, *packet.sizes.values()]).tolist(), needed, len(packet.data)]
    near = {end + step for end in ends for step in (-2, -1, 0, 1, 2)}
    for size in sorted({*near, *range(0, len(packet.data), 17)} & set(range(len(packet.data) + 1))):
        found = first_layer(packet.data[:size])
        assert (found is None) == (size < needed), size
        assert found is None or same_bits(found.gaussians, expected), size


def test_every_damaged_byte_of_the_first_layer_shows_nothing():
    """Only a byte of the header that no first picture needs may be damaged without a trace: the rest's checksum."""
    _, _, packet = make_layers(number=20)
    sound = packet.data[: bytes_needed(packet)]
    expected = first_layer(sound)
    assert expected is not None
    for at in range(len(sound)):
        for flip in (1, 128, 255):
            found = first_layer(sound[:at] + bytes([sound[at] ^ flip]) + sound[at + 1 :])
            assert found is None or (found.frame == 5 and same_bits(found.gaussians, expected.gaussians)), at


def test_packets_without_layers_have_no_first_layer():
    packet = encode_key(make_key(np.random.default_rng(3)))
    assert first_layer(packet.data) is None
    assert first_layer(b"") is None
    assert first_layer(b"\0" * 200) is None


def test_a_lie_about_the_first_layer_costs_nothing(bounded_memory):
    """Four million Gaussians of one value each cost no bytes: as of whole packets, the bytes there are bound them."""
    _, _, packet = make_layers()
    data = bytearray(packet.data)
    data[21:25] = struct.pack("<I", 4_000_000)
    assert first_layer(bytes(data)) is None


def test_sections_stand_in_their_order_and_none_is_missing():
    _, _, packet = make_layers()
    header, sections = parse_packet(packet.data)
    parts = [(name, section.data) for name, section in sections.items()]
    attributes = ["means", "quats", "scales", "opacities", "sh0", "shN"]
    assert list(sections) == ["layers", "meta", *attributes, "layout", "rest"]
    kept = [[part for part in parts if part[0] != missing] for missing in sections]
    for order in ([*parts[1:], parts[0]], [parts[0], parts[-1], *parts[1:-1]], *kept):
        with pytest.raises(PacketError, match="expected sections"):
            decode_key(build_packet(header.kind, header.frame, order).data)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [(0, 61, "cannot be"), (1, 3, "cannot be"), (2, 0, "checksum"), (0, 1, "head|words|symbol|position|bytes")],
)
def test_lies_of_the_head_are_refused_with_their_byte(field, value, message):
    _, _, packet = make_layers()
    head = list(struct.unpack("<III", packet.data[21:33]))
    head[field] = value
    with pytest.raises(PacketError, match=message) as caught:
        decode_key(replaced(packet, "layers", struct.pack("<III", *head)), offset=100)
    assert caught.value.offset is not None
    assert 100 <= caught.value.offset <= 100 + len(packet.data)


@pytest.mark.parametrize("head", [b"", b"\0" * 11, b"\0" * 13])
def test_a_head_of_another_size_is_refused(head):
    _, _, packet = make_layers()
    data = replaced(packet, "layers", head)
    with pytest.raises(PacketError, match="expected 12 bytes"):
        decode_key(data)
    assert first_layer(data) is None


def test_marks_of_another_number_of_gaussians_are_refused():
    """The rest of another choice of as many bytes, under checksums that hold."""
    state, first, packet = make_layers()
    other = first.copy()
    other[np.flatnonzero(first)[0]] = False
    _, sections = parse_packet(encode_key(state, frame=5, first=other).data)
    with pytest.raises(PacketError):
        decode_key(replaced(packet, "rest", sections["rest"].data))


def test_layers_of_other_widths_are_refused():
    _, first, packet = make_layers()
    wide = encode_key(make_key(np.random.default_rng(2), len(first), sh_rest=8), first=first)
    _, sections = parse_packet(wide.data)
    with pytest.raises(PacketError, match="the first layer has 3"):
        decode_key(replaced(packet, "rest", sections["rest"].data))


@pytest.mark.parametrize("first", [np.ones(59, bool), np.ones((60, 1), bool), np.ones(60, np.uint8)])
def test_a_choice_that_does_not_fit_is_refused(first):
    with pytest.raises(ShapeError, match="first"):
        encode_key(make_key(np.random.default_rng(1), 60), first=first)


def test_the_checksum_is_that_of_the_sections_that_a_picture_needs():
    """By the words of the format page, with zlib alone."""
    _, first, packet = make_layers()
    number, size, checksum = struct.unpack("<III", packet.data[21:33])
    assert packet.data[16] == 11
    assert number == first.sum()
    assert packet.data[33 + size] == 2
    assert zlib.crc32(packet.data[33 : 33 + size]) == checksum
    assert PACKET_HEADER.size == 16


@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_the_tables_of_both_layers_are_counted(share):
    """The measured coder: tables of a section take no more than the section, and as many symbols as without layers."""
    state, _, packet = make_layers(number=200, share=share)
    header, sections = parse_packet(packet.data)
    tables = coded_tables(sections, header.kind, state.layout)
    sizes = {name: sum(table.size for table in tables if table.name == name) for name in packet.sizes}
    for name in set(packet.sizes) - {"header", "layers", "meta"}:
        # Heads and lengths of parts are in no table.
        assert packet.sizes[name] - 40 <= sizes[name] <= packet.sizes[name], name
    assert all(table.entropy_bits <= 8 * table.size for table in tables)
