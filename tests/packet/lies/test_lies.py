"""Sections that lie under correct checksums are refused with their place, before they cost much or change anything."""

from __future__ import annotations

import tracemalloc

import pytest
from delta_lies import residual_victim, row_victim
from field_lies import field_victim
from key_lies import key_victim, meta_victim
from light_lies import light_victim
from motion_lies import motion_victim
from packet_scenes import replaced

from gsstream.core.errors import PacketError
from gsstream.packet import PlayerState, decode_packet
from gsstream.packet.base import parse_packet

VICTIMS = (
    key_victim(),
    meta_victim(),
    residual_victim(),
    motion_victim(),
    field_victim(),
    row_victim(),
    light_victim(),
)
# Made here, not in the test: under the count of memory they would take several times as long.
LIES = [
    pytest.param(victim.state, replaced(victim.packet, section, data), section, message, id=f"{section}: {name}")
    for victim in VICTIMS
    for name, section, data, message in victim.lies
]


@pytest.mark.filterwarnings("error")
@pytest.mark.usefixtures("bounded_memory")
@pytest.mark.parametrize(("state", "data", "section", "message"), LIES)
def test_lies_are_refused_at_their_section_and_leave_the_state_alone(
    state: PlayerState | None, data: bytes, section: str, message: str
) -> None:
    before = [] if state is None else [array.tobytes() for _, array in state.gaussians.items()]
    tracemalloc.reset_peak()
    start = tracemalloc.get_traced_memory()[0]
    with pytest.raises(PacketError) as caught:
        decode_packet(state, data, offset=1000)
    assert tracemalloc.get_traced_memory()[1] - start < 1 << 20
    assert message in str(caught.value)
    assert caught.value.offset == 1000 + parse_packet(data)[1][section].offset
    assert str(caught.value).count("(at byte") == 1
    assert before == ([] if state is None else [array.tobytes() for _, array in state.gaussians.items()])
