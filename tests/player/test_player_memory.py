"""A player's own memory limit: hostile streams are refused before they are decoded, honest ones play within it."""

from __future__ import annotations

import sys
import tracemalloc
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_player import make_stream

from gsstream.cli.main import run_command
from gsstream.core.cameras import Cameras
from gsstream.core.changes import Delta
from gsstream.core.errors import InputError
from gsstream.core.gaussians import Gaussians
from gsstream.core.memory import VARIABLE, limited_memory
from gsstream.packet import KeyState, StreamReader, StreamWriter, decode_packet, encode_delta, encode_key
from gsstream.player.memory import MemoryLimit
from gsstream.player.play import play
from gsstream.player.playback import Playback
from gsstream.player.render import PlayerRenderer, named_renderer, render

sys.path.insert(0, str(Path(__file__).parents[1] / "packet"))
from packet_scenes import make_delta, make_edit, make_key, make_motions

from tools.hostile_streams import STREAMS

MB = 1_000_000


def many_equal(path: Path, number: int) -> Path:
    """A stream of few bytes for many Gaussians, as nobody's encoder writes it: one row, announced ``number`` times."""
    state = make_key(np.random.default_rng(0), 1, 1, 15)
    scene = state.gaussians.map(lambda a: np.repeat(a, number, axis=0))
    layout = type(state.layout)(np.int32([number]), np.zeros(number, np.uint8), state.layout.units)
    with StreamWriter.open(path) as writer:
        writer.append(encode_key(KeyState(scene, layout, state.meta)))
    return path


def test_a_small_file_that_announces_much_is_refused_cheaply(tmp_path) -> None:
    path = many_equal(tmp_path / "h.gss", 65_000)
    assert path.stat().st_size < 5000
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match="about 115 MB; the limit is 20 MB"):
            Playback(path, max_memory=20 * MB)
        assert tracemalloc.get_traced_memory()[1] < MB
    finally:
        tracemalloc.stop()
    with Playback(path, max_memory=200 * MB) as playback:
        assert len(playback.state_at(0)) == 65_000


@pytest.mark.parametrize(
    ("name", "trusted"), [("1,100,000 Gaussians of degree 3", False), ("a scene of one Gaussian", True)]
)
def test_a_small_stream_is_trusted_with_little_where_nobody_names_a_limit(
    name: str, trusted: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    data = STREAMS[name]()
    assert len(data) <= 16_384
    path = tmp_path / "s.gss"
    path.write_bytes(data)
    with StreamReader(path) as reader:
        (entry,) = reader.frames
        key = reader.read(entry)
    limit = MemoryLimit()
    if trusted:
        limit.check_decoding(key, None, entry.offset)
    else:
        with pytest.raises(InputError, match=r"takes about 1,9\d\d MB; the limit is 216 MB. Raise --max-memory"):
            limit.check_decoding(key, None, entry.offset)
        limit.check_decoding(key, None, 2_000_000)  # the same behind the bytes of a large scene
    # Whoever names a limit is taken at his word, in either direction.
    monkeypatch.setenv(VARIABLE, "9GB")
    limit.check_decoding(key, None, entry.offset)
    with limited_memory(1), pytest.raises(InputError, match="the limit is"):
        limit.check_decoding(key, None, entry.offset)


@pytest.mark.parametrize("sh_rest", [0, 3, 15])
def test_the_estimate_bounds_what_decoding_takes(sh_rest) -> None:
    """Peaks of keys, deltas, deltas with added Gaussians and with motions, each against what was announced for them."""
    rng = np.random.default_rng(1)
    state, number = None, 20_000
    key = make_key(rng, number, number // 8, sh_rest)
    packets = [encode_key(key)]
    state = decode_packet(None, packets[0].data)
    packets.append(encode_delta(make_delta(rng, state.layout, 1.0), state.layout, {}, frame=1))
    state = decode_packet(state, packets[1].data)
    packets.append(encode_delta(make_edit(rng, state, births=5000), state.layout, state.decoders, frame=2))
    state = decode_packet(state, packets[2].data)
    packets.append(encode_delta(make_motions(rng, state.scene, 2), state.layout, {}, frame=3))
    state = decode_packet(state, packets[3].data)
    delta = Delta((*make_motions(rng, state.scene, 1).changes, *make_edit(rng, state, births=5000).changes))
    packets.append(encode_delta(delta, state.layout, {}, frame=4))
    state = None
    for packet in packets:
        smallest = least_limit(packet.data, state)
        tracemalloc.start()
        before = tracemalloc.get_traced_memory()[0]
        following = decode_packet(state, packet.data)
        peak = tracemalloc.get_traced_memory()[1] - before
        tracemalloc.stop()
        held = 0 if state is None else sum(a.nbytes for _, a in state.gaussians.items())
        assert peak + held <= smallest, (sh_rest, packet.kind, peak / 1e6, smallest / 1e6)
        state = following


def least_limit(data: bytes, state) -> int:
    """The smallest limit that lets a packet pass, to one part in a hundred."""
    low, high = 1, 1 << 40
    while high > low * 1.01 + 1:
        middle = (low + high) // 2
        try:
            MemoryLimit(middle).check_decoding(data, state, 0)
            high = middle
        except InputError:
            low = middle
    return high


def test_pictures_count_too(tmp_path) -> None:
    stream = make_stream(tmp_path / "s.gss")
    with pytest.raises(InputError, match="7000 x 4500 pixels takes about 1,606 MB; the limit is 1,000 MB"):
        MemoryLimit(1000 * MB).check_pictures(7000, 4500)
    play(stream, tmp_path / "p", max_memory=2 * MB)
    with pytest.raises(InputError, match="drawing"):
        play(stream, tmp_path / "p.gif", frames=[0, 1, 2, 3, 4] * 40, max_memory=2 * MB)


@pytest.mark.parametrize("command", ["play", "export"])
def test_the_option_of_the_commands(command, tmp_path, capsys) -> None:
    stream = make_stream(tmp_path / "s.gss")
    arguments = [command, str(stream), "--out", str(tmp_path / "o")]
    assert run_command([*arguments, "--max-memory", "1KB"]) == 2
    assert "the limit is 0.001 MB" in capsys.readouterr().err
    assert not (tmp_path / "o").exists()
    assert run_command([*arguments, "--max-memory", "5 parsecs"]) == 2
    assert "--max-memory 5 parsecs" in capsys.readouterr().err
    assert run_command([*arguments, "--max-memory", "50MB"]) == 0


def covering(number: int) -> Gaussians:
    """Gaussians in one place, each of which covers any picture: a few bytes of a packet."""
    state = make_key(np.random.default_rng(0), 1, 1, 0)
    one = replace(
        state.gaussians,
        means=np.float32([[0, 0, 3]]),
        scales=np.full((1, 3), 1, np.float32),
        opacities=np.float32([-2]),
    )
    return one.map(lambda a: np.repeat(a, number, axis=0))


@pytest.fixture
def wide() -> Cameras:
    K = np.array([[300.0, 0, 320], [0, 300, 320], [0, 0, 1]])
    return Cameras(("a",), np.eye(4)[None], K[None], 640, 640)


@pytest.mark.parametrize("name", ["numpy", "cpu"])
def test_gaussians_that_cover_the_picture_are_refused_before_their_pairs_take_memory(name, wide) -> None:
    """65,536 of them on 640 x 640 pixels are a hundred million pairs of Gaussians and tiles."""
    if name == "cpu":
        pytest.importorskip("gsstream_cpu_render")
    renderer = named_renderer(name)
    many = covering(20_000)
    tracemalloc.start()
    try:
        with limited_memory(30 * MB), pytest.raises(InputError, match=r"drawing 20000 Gaussians on 640 x 640 .*Raise"):
            render(many, wide, renderer=renderer)
        assert tracemalloc.get_traced_memory()[1] < 60 * MB
    finally:
        tracemalloc.stop()
    few = covering(20)
    with limited_memory(30 * MB):
        within = render(few, wide, renderer=renderer)
    assert np.array_equal(within, render(few, wide, renderer=renderer))
    with limited_memory(10 * MB), pytest.raises(InputError, match=r"drawing 20 Gaussians on 640 x 640"):
        render(few, wide, renderer=renderer)


def test_a_renderer_that_fails_for_memory_is_one_sentence(wide) -> None:
    def greedy(*_: object, near: float) -> np.ndarray:
        raise MemoryError("std::bad_alloc")

    with pytest.raises(InputError, match=r"takes too much memory: std::bad_alloc. Raise --max-memory"):
        render(covering(1), wide, renderer=PlayerRenderer("greedy", greedy))


@pytest.mark.parametrize(
    "arguments", [["play"], ["play", "--renderer", "numpy"], ["export", "--format", "page"]], ids=" ".join
)
def test_a_small_stream_of_such_gaussians_is_refused_by_every_command(arguments, tmp_path, capsys) -> None:
    state = make_key(np.random.default_rng(0), 1, 1, 0)
    scene, number = covering(20_000), 20_000
    layout = type(state.layout)(np.int32([number]), np.zeros(number, np.uint8), state.layout.units)
    K = np.array([[300.0, 0, 320], [0, 300, 320], [0, 0, 1]])
    rig = Cameras(("a",), np.eye(4)[None], K[None], 640, 640)
    with StreamWriter.open(tmp_path / "s.gss") as writer:
        writer.append(encode_key(KeyState(scene, layout, replace(state.meta, train=rig, test=rig))))
    assert (tmp_path / "s.gss").stat().st_size < 5000
    command, *options = arguments
    given = [command, str(tmp_path / "s.gss"), "--out", str(tmp_path / "o"), *options, "--max-memory", "60MB"]
    assert run_command(given) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: drawing 20000 Gaussians on 640 x 640 pixels takes too much memory: ")
    assert said.count("\n") == 1
