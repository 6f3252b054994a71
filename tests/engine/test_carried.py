"""What is taken over from another stream: its numbers are checked, and its coordinates are left behind."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from gsstream.core.errors import OutputError, PacketError
from gsstream.core.world import IDENTITY
from gsstream.encode import Encoder, encoder_for, open_recording
from gsstream.engine.frame0.carried import in_world, numbers
from gsstream.packet import KeyState, PlayerState, StreamWriter, decode_packet, encode_key
from gsstream.player.render import render
from tools.worlds import world

SOURCE = "synthetic:frames=2&views=3&width=32&height=24&supersample=1"
TINY = {
    "first_frame.max_iterations": 12, "first_frame.max_points": 250, "first_frame.fill_points": 0, "stream.epochs": 1,
    "first_frame.points": "recording",
}  # fmt: skip
LIES = {
    "missing": None, "text": "0 0 0", "short": [0.0, 0.0], "nested": [[0.0, 0.0, 0.0]], "object": {"x": 0},
    "null inside": [0.0, None, 0.0], "huge": [1e300, 0.0, 0.0], "ragged": [[0.0], [0.0, 1.0], 2.0],
}  # fmt: skip


@cache
def first(method: str = "s2gs-edge") -> PlayerState:
    with open_recording(SOURCE) as source:
        return decode_packet(None, encoder_for(method, source, TINY).encode(source.frame(0)).packet.data)


def with_extra(player: PlayerState, **extra) -> PlayerState:
    kept = {key: value for key, value in {**player.meta.extra, **extra}.items() if value is not None}
    return replace(player, meta=replace(player.meta, extra=kept))


def stream_of(player: PlayerState, path) -> None:
    with StreamWriter.open(path) as writer:
        writer.append(encode_key(KeyState(player.gaussians, player.layout, player.meta)))


@pytest.mark.parametrize("lie", LIES)
def test_an_origin_that_is_none_is_named_when_a_run_goes_on(lie, tmp_path):
    stream_of(with_extra(first(), origin=LIES[lie]), tmp_path / "s.gss")
    refused = pytest.raises(PacketError, match=r"extra\.origin: expected finite numbers \[3\].*only played")
    with open_recording(SOURCE) as source, refused:
        encoder_for("s2gs-edge", source, TINY).resume(tmp_path / "s.gss", source.frame)


@pytest.mark.parametrize("lie", [7, {"matrix": [1]}, {"matrix": [[[1.0] * 3] * 3] * 3, "offset": "0"}, {}, []])
def test_exposures_that_fit_no_camera_are_named(lie, tmp_path):
    stream_of(with_extra(first(), exposure=lie), tmp_path / "s.gss")
    with open_recording(SOURCE) as source:
        made = encoder_for("s2gs-edge", source, TINY)
        with pytest.raises(PacketError, match=r"extra\.exposure"):
            made.resume(tmp_path / "s.gss", source.frame)
        begun = Encoder(made.parts, source.info, first_frame=decode_packet(None, _bytes(tmp_path / "s.gss")))
        with pytest.raises(PacketError, match=r"extra\.exposure"):
            begun.encode(source.frame(0))


def _bytes(path) -> bytes:
    from gsstream.packet import StreamReader

    with StreamReader(path) as reader:
        return reader.read(reader.frames[0])


def test_a_scene_without_an_origin_can_be_taken_over():
    """A method that lays its own grid needs none of another's."""
    player = with_extra(first("queen"), origin=None)
    with open_recording(SOURCE) as source:
        made = encoder_for("s2gs-edge", source, TINY)
        step = Encoder(made.parts, source.info, first_frame=player).encode(source.frame(0))
    assert len(step.state.player.gaussians) == len(player.gaussians)


def test_a_scene_of_other_coordinates_is_brought_into_those_of_the_run():
    player, where = first(), world(30.0, (4.0, -7.0, 2.0), turn=4)
    own = player.meta
    theirs = replace(own, world=own.world.after(where.inverse()), train=where.cameras(own.train))
    scene = where.gaussians(player.gaussians).map(lambda values: np.asarray(values, np.float32))
    layout = replace(player.layout, units=np.float32(30.0) * player.layout.units)
    foreign = replace(player, scene=replace(player.scene, gaussians=scene, layout=layout), meta=theirs)
    taken = in_world(foreign, player.meta.world)
    assert taken.layout.units == pytest.approx(player.layout.units, rel=1e-5)
    assert taken.meta.train.viewmats == pytest.approx(player.meta.train.viewmats, abs=1e-9)
    pictures = [render(s.gaussians, player.meta.train, 1, renderer=None) for s in (player, taken)]
    assert pictures[0].std() > 0.03
    assert np.abs(pictures[0] - pictures[1]).max() < 0.01
    assert in_world(player, player.meta.world) is player


def test_a_stream_of_other_coordinates_is_not_continued(tmp_path):
    player = first()
    stream_of(replace(player, meta=replace(player.meta, world=IDENTITY)), tmp_path / "s.gss")
    with open_recording(SOURCE) as source, pytest.raises(OutputError, match="other coordinates"):
        encoder_for("s2gs-edge", source, TINY).resume(tmp_path / "s.gss", source.frame)


def test_numbers_come_as_float32():
    assert numbers([1, 2.5, -3], (3,), "x").dtype == np.float32
