"""A scene taken over from another stream leaves its coordinates behind; a stream of other coordinates ends there."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from similar_worlds import world

from gsstream.core.errors import OutputError
from gsstream.core.world import IDENTITY
from gsstream.encode import encoder_for, open_recording
from gsstream.engine.frame0.reproject import to_stream_coordinates
from gsstream.packet import KeyState, PlayerState, StreamWriter, decode_packet, encode_key
from gsstream.player.render import render

SOURCE = "synthetic:frames=2&views=3&width=32&height=24&supersample=1"
TINY = {
    "first_frame.max_iterations": 12, "first_frame.max_points": 250, "stream.epochs": 1,
    "first_frame.points": "recording",
}  # fmt: skip

@cache
def first(method: str = "s2gs-edge") -> PlayerState:
    with open_recording(SOURCE) as source:
        return decode_packet(None, encoder_for(method, source, TINY).encode(source.frame(0)).packet.data)


def stream_of(player: PlayerState, path) -> None:
    with StreamWriter.open(path) as writer:
        writer.append(encode_key(KeyState(player.gaussians, player.layout, player.meta)))


def test_a_scene_of_other_coordinates_is_brought_into_those_of_the_run():
    player, where = first(), world(30.0, (4.0, -7.0, 2.0), turn=4)
    own = player.meta
    theirs = replace(own, world=own.world.after(where.inverse()), train=where.cameras(own.train))
    scene = where.gaussians(player.gaussians).map(lambda values: np.asarray(values, np.float32))
    layout = replace(player.layout, units=np.float32(30.0) * player.layout.units)
    foreign = replace(player, scene=replace(player.scene, gaussians=scene, layout=layout), meta=theirs)
    taken = to_stream_coordinates(foreign, player.meta.world)
    assert taken.layout.units == pytest.approx(player.layout.units, rel=1e-5)
    assert taken.meta.train.viewmats == pytest.approx(player.meta.train.viewmats, abs=1e-9)
    pictures = [render(s.gaussians, player.meta.train, 1, renderer=None) for s in (player, taken)]
    assert pictures[0].std() > 0.03
    assert np.abs(pictures[0] - pictures[1]).max() < 0.01
    assert to_stream_coordinates(player, player.meta.world) is player


def test_a_stream_of_other_coordinates_is_not_continued(tmp_path):
    player = first()
    stream_of(replace(player, meta=replace(player.meta, world=IDENTITY)), tmp_path / "s.gss")
    with open_recording(SOURCE) as source, pytest.raises(OutputError, match="other coordinates"):
        encoder_for("s2gs-edge", source, TINY).resume(tmp_path / "s.gss", source.frame)
