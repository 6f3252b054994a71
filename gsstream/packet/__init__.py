"""What crosses the wire: key, delta and empty packets in an append-only file. Imports no torch.

``encode_*`` and ``decode_*`` are pure functions between records and complete packets; :class:`StreamWriter` and
:class:`StreamReader` put packets into a file and find them again. Normative text: docs/spec.
"""

from gsstream.core.digest import hash_recipe as hash_recipe
from gsstream.packet.base import FORMAT_VERSION as FORMAT_VERSION
from gsstream.packet.base import EncodedPacket as EncodedPacket
from gsstream.packet.base import PacketKind as PacketKind
from gsstream.packet.changes.residual import quantise_decoders as quantise_decoders
from gsstream.packet.delta import KnownMotions as KnownMotions
from gsstream.packet.delta import decode_delta as decode_delta
from gsstream.packet.delta import decode_empty as decode_empty
from gsstream.packet.delta import encode_delta as encode_delta
from gsstream.packet.delta import encode_empty as encode_empty
from gsstream.packet.delta import next_decoders as next_decoders
from gsstream.packet.key import KeyState as KeyState
from gsstream.packet.key import decode_key as decode_key
from gsstream.packet.key import encode_key as encode_key
from gsstream.packet.key import quantise_key as quantise_key
from gsstream.packet.layers import FirstLayer as FirstLayer
from gsstream.packet.layers import first_layer as first_layer
from gsstream.packet.meta import StreamMeta as StreamMeta
from gsstream.packet.reader import Entry as Entry
from gsstream.packet.reader import StreamReader as StreamReader
from gsstream.packet.state import PlayerState as PlayerState
from gsstream.packet.state import decode_packet as decode_packet
from gsstream.packet.writer import StreamWriter as StreamWriter
