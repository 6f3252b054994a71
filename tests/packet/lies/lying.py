"""What a lie in a packet is: one section with other bytes, under a correct checksum."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

from gsstream.packet import EncodedPacket, PlayerState

#: Name, section, its bytes, and what the refusal says.
Lies = Iterator[tuple[str, str, bytes, str]]


class Victim(NamedTuple):
    """A packet in which sections lie, and the state of a player before it; None for a key packet."""

    state: PlayerState | None
    packet: EncodedPacket
    lies: Lies


#: A part is missing, and the lengths of the others are read from its bytes.
PAST = "length of a part runs past the end of its section"
#: A table has other rows or columns than its bytes.
LEFT = "entropy-coded words are left over after the last symbol"
