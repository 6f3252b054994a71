"""Play from Python: packets in, Gaussians and pictures out. Needs no torch.

::

    from gsstream.play import Playback, render, to_bytes

    with Playback("demo.gss") as stream:
        for frame, scene in stream:
            print(frame, len(scene), stream.entry(frame).size)
        image = render(scene, stream.cameras("test"), 0, stream.meta.background)
"""

from gsstream.core.changes import Delta as Delta
from gsstream.core.changes import Scene as Scene
from gsstream.packet import PlayerState as PlayerState
from gsstream.packet import StreamReader as StreamReader
from gsstream.packet import decode_packet as decode_packet
from gsstream.player.export import export as export
from gsstream.player.paths import camera_path as camera_path
from gsstream.player.playback import Playback as Playback
from gsstream.player.render import render as render
from gsstream.player.render import to_bytes as to_bytes

__all__ = [
    "Delta", "Playback", "PlayerState", "Scene", "StreamReader", "camera_path", "decode_packet", "export", "render",
    "to_bytes",
]  # fmt: skip


def __dir__() -> list[str]:
    return __all__
