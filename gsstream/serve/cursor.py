"""Which packet a viewer of a live stream gets next: never a delta without the frame before it."""

from __future__ import annotations

from gsstream.core.errors import PacketError
from gsstream.packet import PacketKind
from gsstream.packet.base import PACKET_HEADER
from gsstream.packet.reader import Entry
from gsstream.serve.follow import Follower


class Cursor:
    """The place of one viewer in a stream that is followed.

    A viewer begins at the newest key packet. One that is more than ``max_lag`` packets late goes on at the newest
    key packet as soon as there is one ahead; until then it gets every packet, because each needs the one before.
    The file is the queue: nothing is kept for a viewer but its place.
    """

    def __init__(self, follower: Follower, *, max_lag: int = 30, after: tuple[int, bytes] | None = None) -> None:
        """Begin at the newest key packet, or after a packet that the viewer has."""
        self.follower, self.max_lag = follower, max_lag
        self.generation = follower.generation
        #: Times that packets were left out.
        self.jumps = 0
        self._place: int | None = None if after is None else self._place_after(*after)
        self._broken = False

    def next(self) -> Entry | None:
        """Return the packet that the viewer gets now, or None until there is one."""
        stream = self.follower
        if stream.generation != self.generation:
            self.generation, self._place, self._broken = stream.generation, None, False
        if not stream.keys:
            return None
        newest = stream.keys[-1]
        if self._place is None:
            self._place = newest
        elif newest > self._place and (self._broken or stream.count - self._place > self.max_lag):
            self._place, self._broken = newest, False
            self.jumps += 1
        if self._broken or self._place >= stream.count:
            return None
        self._place += 1
        return stream.entries[self._place - 1]

    @property
    def at_end(self) -> bool:
        """Whether the viewer was given everything that it can get."""
        stream = self.follower
        return self.generation == stream.generation and (self._broken or (self._place or 0) >= stream.count)

    def refuse(self) -> None:
        """Say that the packet returned last cannot be read: nothing follows it but a later key packet."""
        self._broken = True
        if self._place is not None:
            self._place -= 1

    def _place_after(self, frame: int, header: bytes) -> int | None:
        """The place behind a frame, unless joining at the newest key packet is nearer."""
        stream = self.follower
        if not stream.count or not stream.keys:
            return None
        place = frame - stream.entries[0].frame
        if not stream.keys[-1] <= place < stream.count:
            return None
        entry = stream.entries[place]
        try:
            known = stream.read(entry)[: PACKET_HEADER.size] == header
        except PacketError:
            return None
        return place + 1 if known and entry.kind != PacketKind.INDEX else None
