"""Small scenes, deltas and streams for the packet tests."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.changes import (
    AddedGaussians,
    Delta,
    Field,
    FieldShape,
    Layout,
    Light,
    Motion,
    Residual,
    RowEdit,
    Scene,
    apply_light,
    apply_motion,
    field_rows,
    groups_for,
    sendable_factor,
    sent_rows,
)
from gsstream.core.gaussians import Gaussians
from gsstream.core.world import World
from gsstream.packet import (
    EncodedPacket,
    KeyState,
    PlayerState,
    StreamMeta,
    StreamWriter,
    decode_packet,
    encode_delta,
    encode_empty,
    encode_key,
    quantise_decoders,
)
from gsstream.packet.base import build_packet, parse_packet


def make_scene(rng: np.random.Generator, number: int, sh_rest: int = 3) -> Gaussians:
    return Gaussians(
        means=rng.normal(size=(number, 3)).astype(np.float32),
        quats=rng.normal(size=(number, 4)).astype(np.float32),
        scales=(rng.normal(size=(number, 3)) - 3).astype(np.float32),
        opacities=(3 * rng.normal(size=number)).astype(np.float32),
        sh0=rng.normal(size=(number, 1, 3)).astype(np.float32),
        shN=(0.1 * rng.normal(size=(number, sh_rest, 3))).astype(np.float32),
    )


def make_layout(rng: np.random.Generator, number: int, nodes: int) -> Layout:
    counts = np.bincount(rng.integers(0, nodes, number), minlength=nodes).astype(np.int32)
    return Layout(counts, rng.integers(0, 3, number).astype(np.uint8), np.float32([1.0, 0.3, 0.1]))


def make_meta() -> StreamMeta:
    viewmats = np.tile(np.eye(4), (3, 1, 1))
    viewmats[:, 2, 3] = [2.0, 1 / 3, np.pi]
    K = np.array([[50.0, 0, 16], [0, 51.0, 12], [0, 0, 1]])
    rig = Cameras(("left", "right", "held-out"), viewmats, np.tile(K, (3, 1, 1)), 32, 24, 0.02)
    recipe = {"method": "dense", "gate": {"temperature": 0.3}, "frames": None}
    train, test = rig.select([0, 1]), rig.select([2])
    return StreamMeta("dense", "unit test", recipe, train, test, 30.0, (0.1, 0.2, 0.3), {"p": "1"})


def make_key(rng: np.random.Generator, number: int = 40, nodes: int = 12, sh_rest: int = 3) -> KeyState:
    return KeyState(make_scene(rng, number, sh_rest), make_layout(rng, number, nodes), make_meta())


#: A quarter turn and a bit, UTM coordinates, centimetres.
WORLD = World((0.0, -0.8, 0.6, 1.0, 0.0, 0.0, 0.0, 0.6, 0.8), (500000.25, 5200000.5, 300.125), 100.0)


def make_placed_key(seed: int, **sizes: int) -> EncodedPacket:
    """A key packet whose scene lies in other coordinates than its recording."""
    key = make_key(np.random.default_rng(seed), **sizes)
    return encode_key(replace(key, meta=replace(key.meta, world=WORLD)))


def make_delta(
    rng: np.random.Generator, layout: Layout, share: float = 0.4, levels: int = 4, latent: bool = True
) -> Delta:
    nodes = len(layout.node_counts)
    gates = (rng.random(nodes) < share) * rng.integers(1, levels + 1, nodes)
    rows = len(sent_rows(layout, gates))
    widths = {"means": 3, "quats": 4, "opacities": 1, "sh0": 2 if latent else 3}
    symbols = {n: np.rint(2 * rng.laplace(size=(rows, w))).astype(np.int32) for n, w in widths.items()}
    decoders = quantise_decoders({"sh0": rng.normal(size=(2, 3))}) if latent else {}
    return Delta((Residual(gates.astype(np.uint8), levels, symbols, dict.fromkeys(widths, 0.01), decoders),))


def make_births(rng: np.random.Generator, layout: Layout, number: int, new: int, sh_rest: int = 3) -> AddedGaussians:
    nodes = len(layout.node_counts)
    parents = nodes + np.arange(new) - rng.integers(0, 3, new).clip(0, nodes)
    where = np.sort(rng.integers(0, nodes + new, number))
    return AddedGaussians(make_scene(rng, number, sh_rest), where, rng.integers(0, 3, number).astype(np.uint8), parents)


def make_edit(rng: np.random.Generator, state: PlayerState, births: int = 3, deaths: float = 0.2) -> Delta:
    """A delta with added Gaussians in old and new nodes and some removed; one in three moves nothing else."""
    delta = make_delta(rng, state.layout, share=0.4 * int(rng.random() < 0.7))
    gone = np.flatnonzero(rng.random(len(state.gaussians)) < deaths)
    added = None
    if births:
        added = make_births(rng, state.layout, births, int(rng.integers(0, 3)), state.gaussians.shN.shape[1])
    return delta.with_row_edit(RowEdit(added, gone))


def make_motion(
    rng: np.random.Generator,
    scene: Scene,
    cell: float = 1.5,
    brightness_bins: int = 2,
    share: float = 0.6,
    **said: bool,
) -> Motion:
    """A motion of a share of the scene's groups; most corrections are 0."""
    groups = groups_for(scene, cell, brightness_bins, said.get("regroup", False))
    moving = (rng.random(groups.count) < share).astype(np.uint8)
    symbols = np.rint(rng.laplace(size=(int(moving.sum()), 6)) * 2).astype(np.int32)
    return Motion(cell, brightness_bins, moving, symbols, float(np.float32(0.02)), float(np.float32(0.01)), **said)


def make_motions(rng: np.random.Generator, scene: Scene, number: int, **said: bool) -> Delta:
    """A delta of ``number`` motions, coarse to fine: the groups of each depend on where the one before led."""
    motions = []
    for level in range(number):
        motions.append(make_motion(rng, scene, cell=2.0 / 2**level, **said))
        scene, _ = apply_motion(scene, motions[-1])
    return Delta(tuple(motions))


def make_moving_packets(seed: int = 0, **sizes: int) -> list[EncodedPacket]:
    """Key, then frames that move: from rest, predicted, corrected with a residual, still, of groups formed anew, two
    motions at once, with added Gaussians after the motion, predicted with what was added.
    """
    rng = np.random.default_rng(seed)
    state = decode_packet(None, encode_key(make_key(rng, **sizes)).data)
    packets = [encode_key(make_key(np.random.default_rng(seed), **sizes))]

    def add(delta: Delta | None) -> None:
        nonlocal state
        frame = state.frame + 1
        if delta is None:
            packet = encode_empty(frame=frame)
        else:
            packet = encode_delta(delta, state.layout, state.decoders, frame=frame)
        packets.append(packet)
        state = decode_packet(state, packet.data)

    def moved(**said: bool) -> Motion:
        return make_motion(rng, state.scene, **said)

    add(Delta((moved(predicted=False),)))
    still = moved()
    add(Delta((replace(still, symbols=np.zeros_like(still.symbols)),)))
    add(Delta((moved(), *make_delta(rng, state.layout).changes)))
    add(None)
    add(Delta((moved(),)))
    add(Delta((moved(regroup=True),)))
    add(make_motions(rng, state.scene, 2))
    add(Delta((moved(), *make_edit(rng, state).changes)))
    add(Delta((moved(),)))
    return packets


def make_field(
    rng: np.random.Generator, scene: Scene, share: float | None = 0.6, size: int = 9, **said: float
) -> Field:
    """A field over the middle of the scene; ``share`` of its rows are marked, None: all in the box move.

    ``size`` is that of the largest symbols; ``said`` are parts of the shape that are not to be small.
    """
    small = {"levels": 3, "entries": 6, "features": 2, "base": 3, "growth": 1.5, "width": 5, "layers": 2, "seed": 3}
    shape = FieldShape((-1.25, -1.0, -1.0), (1.0, 1.0, 1.5), 0.5, **{**small, **said})
    marks = None if share is None else (rng.random(len(scene.gaussians)) < share).astype(np.uint8)
    _, unit = field_rows(scene, shape, marks)
    sizes = [(len(which), shape.features) for which in shape.touched(unit)]
    sizes += zip(shape.widths[:-1], shape.widths[1:], strict=True)
    tables = tuple(rng.integers(-size, size + 1, each).astype(np.int32) for each in sizes)
    return Field(shape, marks, tables[: shape.levels], tables[shape.levels :], 1 << 14, 1 << 8)


def make_field_packets(seed: int = 0, **sizes: int) -> list[EncodedPacket]:
    """Key, then frames with a field: of marked rows, of all rows, behind a motion and before the rest, a predicted
    motion of what the field moved, and one of a single layer and level.
    """
    rng = np.random.default_rng(seed)
    packets = [encode_key(make_key(rng, **sizes))]
    state = decode_packet(None, packets[0].data)
    for frame in range(1, 6):
        scene = state.scene
        if frame == 1:
            delta = Delta((make_field(rng, scene),))
        elif frame == 2:
            delta = Delta((make_field(rng, scene, None),))
        elif frame == 3:
            motion = make_motion(rng, scene)
            there = apply_motion(scene, motion)[0]
            delta = Delta((motion, make_field(rng, there), *make_edit(rng, state, deaths=0.1).changes))
        elif frame == 4:
            delta = Delta((make_motion(rng, scene),))
        else:
            delta = Delta((make_field(rng, scene, None, levels=1, layers=1, features=1, base=1, growth=1.0),))
        packets.append(encode_delta(delta, state.layout, state.decoders, frame=frame))
        state = decode_packet(state, packets[-1].data)
    return packets


def make_light_packets(seed: int = 0, **sizes: int) -> list[EncodedPacket]:
    """Key, then frames with a light: alone, before a motion and a residual, nothing, before rows that come and go."""
    rng = np.random.default_rng(seed)
    key = make_key(rng, **sizes)
    packets = [encode_key(replace(key, meta=replace(key.meta, background=(0.4, 0.1, 0.25))))]
    state = decode_packet(None, packets[0].data)
    for frame in range(1, 5):
        light = Light(sendable_factor(np.exp(rng.normal(size=3))))
        lit = apply_light(state.scene, light)
        if frame == 1:
            delta = Delta((light,))
        elif frame == 2:
            delta = Delta((light, make_motion(rng, lit, predicted=False), *make_delta(rng, state.layout).changes))
        elif frame == 4:
            delta = Delta((light, make_motion(rng, lit), *make_edit(rng, state).changes))
        packet = (
            encode_empty(frame=frame) if frame == 3 else encode_delta(delta, state.layout, state.decoders, frame=frame)
        )
        packets.append(packet)
        state = decode_packet(state, packet.data)
    return packets


def begin(rng: np.random.Generator, number: int = 40, nodes: int = 12, reach: float = 1.0) -> PlayerState:
    """The state after a key packet; ``reach`` scales where the Gaussians are."""
    key = make_key(rng, number, nodes)
    means = (key.gaussians.means * np.float32(reach)).astype(np.float32)
    key = replace(key, gaussians=replace(key.gaussians, means=means))
    return decode_packet(None, encode_key(key).data)


def follow(state: PlayerState, delta: Delta) -> PlayerState:
    """What players have after the packet of a delta."""
    return decode_packet(state, encode_delta(delta, state.layout, state.decoders, frame=state.frame + 1).data)


def moving_state() -> tuple[PlayerState, Delta]:
    """A state after a motion, and a motion that goes on from it."""
    rng = np.random.default_rng(8)
    state = begin(rng, 30, 9)
    state = follow(state, Delta((make_motion(rng, state.scene, predicted=False),)))
    return state, Delta((make_motion(rng, state.scene, share=0.7),))


def make_packets(
    seed: int = 0, frames: int = 7, key_at: int = 4, edits: tuple[int, ...] = (), layers: bool = False, **sizes: int
) -> list[EncodedPacket]:
    """Key, deltas with a decoder that changes once, an empty packet at frame 2, a second key; rows added at ``edits``.

    With ``layers`` the key packets have them.
    """
    rng = np.random.default_rng(seed)
    state: PlayerState | None = None
    packets = []
    for frame in range(frames):
        if frame in (0, key_at):
            key = make_key(rng, **sizes)
            packet = encode_key(key, frame=frame, first=rng.random(len(key.gaussians)) < 0.6 if layers else None)
        elif frame == 2:
            packet = encode_empty(frame=frame)
        elif frame in edits:
            packet = encode_delta(make_edit(rng, state), state.layout, state.decoders, frame=frame)
        else:
            packet = encode_delta(make_delta(rng, state.layout), state.layout, state.decoders, frame=frame)
        packets.append(packet)
        state = decode_packet(state, packet.data)
    return packets


def decode_all(packets: list[EncodedPacket]) -> list[PlayerState]:
    states: list[PlayerState] = []
    for packet in packets:
        states.append(decode_packet(states[-1] if states else None, packet.data))
    return states


def write_stream(path: Path, packets: list[EncodedPacket], index: bool = True) -> bytes:
    writer = StreamWriter.open(path)
    for packet in packets:
        writer.append(packet)
    writer.close(index=index)
    return path.read_bytes()


def same_bits(first: Gaussians, second: Gaussians) -> bool:
    pairs = zip(first.items(), second.items(), strict=True)
    return all(a.shape == b.shape and a.dtype == b.dtype and a.tobytes() == b.tobytes() for (_, a), (_, b) in pairs)


def resealed(packet, mutate):
    """The packet with mutated section payloads and correct checksums: only the decoders can notice."""
    header, sections = parse_packet(packet.data)
    return build_packet(header.kind, header.frame, [(name, mutate(name, s.data)) for name, s in sections.items()]).data


def replaced(packet, name, data):
    """The packet with another payload of one section."""
    return resealed(packet, lambda n, old: data if n == name else old)
