"""Meta that is well-formed JSON and no sensible recording: refused when read, and not written either."""

from __future__ import annotations

import dataclasses
import json

import pytest
from packet_scenes import make_meta, make_packets, write_stream

from gsstream.core.errors import PacketError, ShapeError
from gsstream.core.world import World
from gsstream.packet import StreamReader, StreamWriter
from gsstream.packet.base import PACKET_HEADER
from gsstream.packet.meta import meta_from_json, meta_to_json


@pytest.mark.parametrize("number", ["1e999", "-1e999", "NaN", "Infinity"])
@pytest.mark.parametrize("place", ['"temperature": 0.3', '"fps": 30.0'])
def test_numbers_that_are_not_finite_are_refused(number: str, place: str) -> None:
    """1e999 is well-formed JSON and reads as infinity: its recipe has no canonical form and no hash."""
    data = json.dumps(json.loads(meta_to_json(make_meta())))
    assert place in data
    with pytest.raises(PacketError, match="meta"):
        meta_from_json(data.replace(place, f"{place.partition(':')[0]}: {number}").encode())


def test_a_recipe_nested_too_deep_is_refused() -> None:
    text = meta_to_json(make_meta()).decode()
    deep = '{"a":' * 20_000 + "1" + "}" * 20_000
    with pytest.raises(PacketError, match="meta"):
        meta_from_json(text.replace('"recipe":{', f'"recipe":{{"x":{deep},').encode())


BAD_FIELDS = {"fps": 0.0, "background": (0.0, float("nan"), 0.0), "plugins": {"p": 1}, "extra": {"source_uri": 5}}


@pytest.mark.parametrize("name", BAD_FIELDS)
def test_what_is_not_read_is_not_written(name: str) -> None:
    with pytest.raises(ShapeError, match="meta"):
        meta_to_json(dataclasses.replace(make_meta(), **{name: BAD_FIELDS[name]}))


def test_a_torn_last_packet_before_reserved_zeros_is_cut_off(tmp_path) -> None:
    """A crash can leave any beginning of the last packet, then zeros; every other packet must stay."""
    packets = make_packets()
    data = write_stream(tmp_path / "whole.gss", packets, index=False)
    with StreamReader(tmp_path / "whole.gss") as reader:
        last = reader.frames[-1]
    path = tmp_path / "torn.gss"
    # The last bytes of this packet are zeros: a cut there loses nothing, so the cuts stay before them.
    cuts = 1, 5, PACKET_HEADER.size - 2, PACKET_HEADER.size, PACKET_HEADER.size + 7, last.size // 2, last.size
    for cut in cuts:
        for zeros in (0, 3, last.size, 5 * last.size):
            path.write_bytes(data[: last.offset + cut] + bytes(zeros))
            with StreamWriter.open(path, resume=True) as writer:
                assert writer.next_frame == last.frame + (cut == last.size), (cut, zeros)
                for packet in packets[writer.next_frame :]:
                    writer.append(packet)
                writer.close(index=False)
            assert path.read_bytes() == data, (cut, zeros)


def test_a_world_comes_back_bit_by_bit_and_the_identity_is_not_written() -> None:
    assert "world" not in json.loads(meta_to_json(make_meta()))
    world = World((0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0), (5e5 + 1 / 3, 5.2e6, 300.0), 1 / 7)
    data = meta_to_json(dataclasses.replace(make_meta(), world=world))
    assert meta_from_json(data).world == world
    assert set(json.loads(data)["world"]) == {"rotation", "offset", "scale"}
    with pytest.raises(ShapeError, match="world"):
        meta_to_json(dataclasses.replace(make_meta(), world=dataclasses.replace(world, scale=float("inf"))))
