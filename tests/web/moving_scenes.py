"""Streams with every kind of change: motions of groups, residuals, added and removed Gaussians, one after another."""

from __future__ import annotations

import numpy as np

from gsstream.core.cameras import Cameras
from gsstream.core.changes import (
    AddedGaussians,
    Delta,
    Layout,
    Light,
    Motion,
    Residual,
    RowEdit,
    Scene,
    apply_light,
    apply_motion,
    groups_for,
    sendable_factor,
)
from gsstream.core.changes.residual import sent_rows
from gsstream.core.gaussians import Gaussians
from gsstream.packet import (
    EncodedPacket,
    KeyState,
    PlayerState,
    StreamMeta,
    decode_packet,
    encode_delta,
    encode_empty,
    encode_key,
    quantise_decoders,
)


def make_gaussians(rng: np.random.Generator, number: int, sh_rest: int) -> Gaussians:
    return Gaussians(
        means=rng.normal(size=(number, 3)).astype(np.float32),
        quats=rng.normal(size=(number, 4)).astype(np.float32),
        scales=(rng.normal(size=(number, 3)) - 3).astype(np.float32),
        opacities=(3 * rng.normal(size=number)).astype(np.float32),
        sh0=rng.normal(size=(number, 1, 3)).astype(np.float32),
        shN=(0.1 * rng.normal(size=(number, sh_rest, 3))).astype(np.float32),
    )


def make_meta() -> StreamMeta:
    viewmats = np.tile(np.eye(4), (2, 1, 1))
    viewmats[:, 2, 3] = [2.0, np.pi]
    K = np.array([[50.0, 0, 16], [0, 51.0, 12], [0, 0, 1]])
    rig = Cameras(("left", "held-out"), viewmats, np.tile(K, (2, 1, 1)), 32, 24, 0.02)
    train, test = rig.select([0]), rig.select([1])
    return StreamMeta("dense", "unit test", {"method": "dense"}, train, test, 30.0, (0.1, 0.2, 0.3))


def make_motion(rng: np.random.Generator, scene: Scene, cell: float, brightness_bins: int) -> Motion:
    regroup = bool(rng.random() < 0.2)
    groups = groups_for(scene, cell, brightness_bins, regroup)
    moving = (rng.random(groups.count) < 0.5).astype(np.uint8)
    symbols = np.rint(3 * rng.laplace(size=(int(moving.sum()), 6))).astype(np.int32)
    predicted = bool(rng.random() < 0.7)
    steps = (float(np.float32(0.01)), float(np.float32(0.003)))
    return Motion(cell, brightness_bins, moving, symbols, *steps, predicted, regroup)


def make_residual(rng: np.random.Generator, layout: Layout) -> Residual:
    nodes = len(layout.node_counts)
    gates = ((rng.random(nodes) < 0.4) * rng.integers(1, 5, nodes)).astype(np.uint8)
    rows = len(sent_rows(layout, gates))
    widths = {"means": 3, "quats": 4, "opacities": 1, "sh0": 2}
    symbols = {n: np.rint(2 * rng.laplace(size=(rows, w))).astype(np.int32) for n, w in widths.items()}
    decoders = quantise_decoders({"sh0": rng.normal(size=(2, 3))})
    return Residual(gates, 4, symbols, dict.fromkeys(widths, 0.01), decoders)


def make_rows(rng: np.random.Generator, scene: Scene, sh_rest: int) -> RowEdit:
    nodes, number = len(scene.layout.node_counts), len(scene.gaussians)
    count, new = int(rng.integers(1, 9)), int(rng.integers(0, 3))
    parents = nodes + np.arange(new) - rng.integers(0, 3, new).clip(0, nodes)
    where = np.sort(rng.integers(0, nodes + new, count))
    added = AddedGaussians(
        make_gaussians(rng, count, sh_rest), where, rng.integers(0, 3, count).astype(np.uint8), parents
    )
    gone = np.flatnonzero(rng.random(number) < 0.05)
    return RowEdit(added if rng.random() < 0.8 or not len(gone) else None, gone)


def make_delta(rng: np.random.Generator, scene: Scene, sh_rest: int, lights: bool) -> Delta:
    """Perhaps a light, zero to three motions, perhaps a residual, perhaps rows; at least one but the light."""
    changes: list[Light | Motion | Residual | RowEdit] = []
    after = scene
    if lights and rng.random() < 0.4:
        changes.append(Light(sendable_factor(np.exp(0.5 * rng.normal(size=3)))))
        after = apply_light(scene, changes[0])
    for _ in range(int(rng.integers(0, 4))):
        cell, brightness_bins = [(0.5, 1), (0.5, 1), (0.25, 4)][int(rng.integers(3))]
        motion = make_motion(rng, after, cell, brightness_bins)
        changes.append(motion)
        after = apply_motion(after, motion)[0]
    if rng.random() < 0.7:
        changes.append(make_residual(rng, scene.layout))
    if rng.random() < 0.5 or not changes or (len(changes) == 1 and isinstance(changes[0], Light)):
        changes.append(make_rows(rng, scene, sh_rest))
    return Delta(tuple(changes))


def moving_packets(
    seed: int,
    frames: int = 12,
    number: int = 300,
    nodes: int = 40,
    sh_rest: int = 3,
    key_at: int = 7,
    *,
    lights: bool = True,
) -> list[EncodedPacket]:
    """A stream whose deltas hold every order and number of changes; the packet of frame 4 is empty.

    Without ``lights`` colours stay between those that another engine's splats can hold.
    """
    rng = np.random.default_rng(seed)
    state: PlayerState | None = None
    packets = []
    for frame in range(frames):
        if state is None or frame == key_at:
            counts = np.bincount(rng.integers(0, nodes, number), minlength=nodes).astype(np.int32)
            layout = Layout(counts, rng.integers(0, 3, number).astype(np.uint8), np.float32([1.0, 0.3, 0.1]))
            packet = encode_key(KeyState(make_gaussians(rng, number, sh_rest), layout, make_meta()), frame=frame)
        elif frame == 4:
            packet = encode_empty(frame=frame)
        else:
            delta = make_delta(rng, state.scene, sh_rest, lights)
            packet = encode_delta(delta, state.layout, state.decoders, frame=frame)
        packets.append(packet)
        state = decode_packet(state, packet.data)
    return packets
