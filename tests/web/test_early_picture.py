"""Key packets with layers in the browser's decoder, and a page that draws the first layer before it has the rest."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from browser_runs import MESSAGE, PLAYER, READY, at, in_browser, needs_browser, serving, try_in_browser
from decoder_fuzz import digest
from node_runs import needs_node, node, play_in_node
from packet_scenes import make_key
from pictures import decoded, drawn, psnr

from gsstream.core.changes import Layout
from gsstream.packet import (
    EncodedPacket,
    KeyState,
    StreamWriter,
    decode_key,
    encode_empty,
    encode_key,
    first_layer,
)
from gsstream.packet.base import file_header
from gsstream.player.playback import Playback
from gsstream.serve.package import package

FIRST = """
    const { firstLayer } = await load('layers.js');
    const { ATTRIBUTES } = await load('limits.js');
    const { createHash } = await import('node:crypto');
    return given.map((hex) => {
      const state = firstLayer(new Uint8Array(Buffer.from(hex, 'hex')));
      const hash = createHash('sha256');
      for (const name of ATTRIBUTES) {
        const values = state?.scene[name];
        if (values) hash.update(new Uint8Array(values.buffer, values.byteOffset, values.byteLength));
      }
      return state && [state.frame, state.number, state.meta.fps, hash.digest('hex')];
    });"""


@needs_node
@pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
def test_every_cut_gives_nothing_or_the_first_layer_of_python(tmp_path, share):
    rng = np.random.default_rng(4)
    key = make_key(rng, 30)
    packet = encode_key(key, frame=7, first=rng.random(30) < share).data
    found = node(FIRST, [packet[:size].hex() for size in range(len(packet) + 1)], tmp_path)
    for size, got in enumerate(found):
        expected = first_layer(packet[:size])
        assert (got is None) == (expected is None), size
        if expected is not None:
            gaussians = expected.gaussians
            assert got == [7, len(gaussians), expected.meta.fps, digest(gaussians)], size
    assert None in found
    assert found[-1] is not None


@needs_node
def test_a_damaged_first_layer_is_never_shown(tmp_path):
    rng = np.random.default_rng(5)
    packet = encode_key(make_key(rng, 20), first=rng.random(20) < 0.5).data
    sound = first_layer(packet)
    damaged = [packet[:at] + bytes([packet[at] ^ 85]) + packet[at + 1 :] for at in range(len(packet))]
    for got in node(FIRST, [data.hex() for data in damaged], tmp_path):
        assert got is None or got[1:] == [len(sound.gaussians), sound.meta.fps, digest(sound.gaussians)]


@needs_node
@pytest.mark.parametrize(("share", "sh_rest", "number"), [(0, 0, 1), (1, 15, 30), (0.5, 3, 300), (0.5, 8, 0)])
def test_packets_with_layers_decode_to_the_same_bits(tmp_path, share, sh_rest, number):
    rng = np.random.default_rng(6)
    packet = encode_key(make_key(rng, number, sh_rest=sh_rest), first=rng.random(number) < share)
    (found,) = play_in_node([file_header() + packet.data], tmp_path)["streams"]
    assert found["error"] is None
    assert found["digests"] == [digest(decode_key(packet.data).gaussians)]


EARLY = f"{PLAYER}?.statistics.early"
#: RGBA bytes of what the renderer has, from the camera that is looked from first, at the size of the recording.
PICTURE = f"""(async () => {{
  const {{ cameraOf, viewsOf }} = await import('/camera.js');
  const {{ canvas, renderer }} = {PLAYER};
  Object.assign(canvas, {{ width: 32, height: 24 }});
  renderer.draw(cameraOf(viewsOf({PLAYER}._meta)[0], 32, 24), {{ exact: true }});
  let text = "";
  for (let y = 23; y >= 0; y -= 1) {{
    const bytes = new Uint8Array(4 * 32);
    renderer.gl.readPixels(0, y, 32, 1, renderer.gl.RGBA, renderer.gl.UNSIGNED_BYTE, bytes);
    text += String.fromCharCode(...bytes);
  }}
  return btoa(text);
}})()"""


def written(folder, packet: EncodedPacket) -> Path:
    """A stream of this key packet and two empty ones."""
    path = folder / "s.gss"
    with StreamWriter.open(path) as writer:
        for one in (packet, encode_empty(frame=1), encode_empty(frame=2)):
            writer.append(one)
    return path


def layered(seed: int = 1, number: int = 300) -> tuple[KeyState, EncodedPacket]:
    """A scene and its key packet, of which every second Gaussian comes first."""
    key = make_key(np.random.default_rng(seed), number)
    return key, encode_key(key, first=np.arange(number) % 2 == 0)


def needed(packet: EncodedPacket) -> int:
    """Bytes of a segment's file after which the first layer is there."""
    return 16 + len(packet.data) - packet.sizes["rest"] - packet.sizes["layout"] - 10


@needs_browser
@pytest.mark.parametrize("name", ["stream.json", "stream.gss"])
def test_the_first_layer_is_drawn_before_the_rest_is_there(tmp_path, name):
    key, packet = layered()
    stream = written(tmp_path, packet)
    package(stream, tmp_path / "site")
    (tmp_path / "site" / "stream.gss").write_bytes(stream.read_bytes())
    found = first_layer(packet.data)
    alone = Layout(np.int32([150]), np.zeros(150, np.uint8), np.float32([1]))
    (tmp_path / "first").mkdir()
    first = written(tmp_path / "first", encode_key(KeyState(found.gaussians, alone, key.meta)))
    steps = [
        ["go", f"URL/index.html?src={name}"], ["until", EARLY, 30], ["evaluate", f"[{EARLY}, {PLAYER}.state]"],
        ["evaluate", PICTURE], ["evaluate", "fetch('mended')"], READY, ["picture", 0, 32, 24],
        ["evaluate", f"[{PLAYER}.state.number, {PLAYER}.frame, {PLAYER}.problem, {MESSAGE}]"],
    ]  # fmt: skip
    with serving(tmp_path / "site", held_after=needed(packet)) as (url, _):
        results = in_browser(at(url, steps), tmp_path, size=(64, 48))
    assert results[2] == [150, None]
    early, late = (decoded(results[i], 32, 24) for i in (3, 6))
    with Playback(first) as some, Playback(stream) as whole:
        assert psnr(drawn(some, 0), early) >= 45
        assert psnr(drawn(whole, 0), late) >= 45
        assert psnr(drawn(some, 0), drawn(whole, 0)) < 40, "the two pictures are hardly different"
    assert results[7] == [300, 0, None, ""]


@needs_browser
def test_a_byte_less_than_the_first_layer_draws_nothing(tmp_path):
    _, packet = layered()
    package(written(tmp_path, packet), tmp_path / "site")
    steps = [
        ["go", "URL/index.html"],
        ["until", f"{PLAYER}?.buffer"],
        ["pause", 1500],
        ["evaluate", f"[{EARLY} ?? null, {PLAYER}.state, {PLAYER}.statistics.drawn]"],
        ["evaluate", "fetch('mended')"],
        READY,
        ["evaluate", f"{PLAYER}.problem"],
    ]
    with serving(tmp_path / "site", held_after=needed(packet) - 1) as (url, _):
        results = in_browser(at(url, steps), tmp_path, size=(64, 48))
    assert results[3] == [None, None, 0]
    assert results[-1] is None


@needs_browser
@pytest.mark.parametrize("where", ["first", "rest"])
def test_a_damaged_layer_does_no_harm(tmp_path, where):
    """A damaged first layer shows nothing; a sound one of a damaged packet is shown, and then what is wrong is said."""
    _, packet = layered()
    package(written(tmp_path, packet), tmp_path / "site")
    (segment,) = (tmp_path / "site" / "segments").glob("*.gss")
    data = bytearray(segment.read_bytes())
    data[needed(packet) + (-300 if where == "first" else 300)] ^= 255
    segment.write_bytes(data)
    wait = ["pause", 1500] if where == "first" else ["until", EARLY]
    steps = [
        ["go", "URL/index.html"], ["until", f"{PLAYER}?.buffer"], wait,
        ["evaluate", f"{EARLY} ?? null"], ["evaluate", "fetch('mended')"], ["until", f"{PLAYER}.problem"],
        ["evaluate", MESSAGE], ["evaluate", f"{PLAYER}.state"],
    ]  # fmt: skip
    with serving(tmp_path / "site", held_after=needed(packet)) as (url, _):
        results, messages = try_in_browser(at(url, steps), tmp_path, size=(64, 48))
    assert results[3] == (None if where == "first" else 150)
    assert "damaged" in results[6]
    assert results[7] is None
    assert messages == []
