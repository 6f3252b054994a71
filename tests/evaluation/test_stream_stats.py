"""Stream statistics against the file, against entropies computed another way, and against known streams."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
import zstandard
from test_player import make_stream

from gsstream.cli.main import run_command
from gsstream.core.changes import Delta, Layout, Residual
from gsstream.core.errors import PacketError
from gsstream.core.gaussians import Gaussians
from gsstream.core.log import FrameLog
from gsstream.engine.step.metrics import log_packet
from gsstream.evaluation.records import FrameRecord, record_of
from gsstream.evaluation.stream_stats import entropy_bits, stream_stats
from gsstream.evaluation.summary import summarise
from gsstream.packet import KeyState, StreamReader, StreamWriter, decode_packet, encode_delta, encode_empty, encode_key
from gsstream.player.playback import Playback


def entropy_by_hand(values) -> float:
    """Bits, symbol by symbol."""
    values = list(np.ravel(values).tolist())
    return sum(-math.log2(values.count(v) / len(values)) for v in values)


def test_entropy_of_known_tables():
    assert entropy_bits([1, 1, 1]) == 0
    assert entropy_bits([0, 1] * 8) == 16
    assert entropy_bits([]) == 0
    table = np.rint(np.random.default_rng(0).laplace(size=300) * 2)
    assert entropy_bits(table) == pytest.approx(entropy_by_hand(table))


def test_bytes_are_those_of_the_file(tmp_path):
    path = make_stream(tmp_path / "s.gss")
    stats = stream_stats(path)
    with StreamReader(path) as reader:
        assert [(p.frame, p.size) for p in stats.packets] == [(e.frame, e.size) for e in reader.frames]
    assert all(sum(p.sections.values()) == p.size for p in stats.packets)
    assert [p.kind for p in stats.packets] == ["key", "delta", "empty", "delta", "delta"]
    sizes = [p.size for p in stats.packets]
    assert stats.kb_per_frame == pytest.approx(sum(sizes[1:]) / 4 / 1000)
    assert stats.kb_amortised == pytest.approx(sum(sizes) / 5 / 1000)
    assert stats.mbit_per_second == pytest.approx(sum(sizes[1:]) / 4 * 8 * 25 / 1e6)
    assert stats.sections("key")["means"] == stats.packets[0].sections["means"]
    assert stats.raw_key_bytes == 150 * 4 * (14 + 24)
    assert (stats.packets[2].size, stats.packets[2].paper, stats.packets[2].sent_gaussians) == (16, 0, 0)


def test_paper_estimate_and_plain_codec_of_a_delta(tmp_path):
    """Counted by hand from the definition: offsets as float32, other symbols over all Gaussians, open and closed."""
    path = make_stream(tmp_path / "s.gss")
    stats = stream_stats(path)
    with Playback(path) as playback:
        delta, scene = playback.player_state(1).delta.residual, playback.state_at(1)
    opened = int(np.count_nonzero(delta.gates))
    expected = (96 * opened + entropy_by_hand(delta.gates != 0)) / 8
    packet = stats.packets[1]
    assert packet.paper == pytest.approx(expected)
    assert packet.open_gates == packet.sent_gaussians == opened  # every Gaussian has a gate of its own
    assert packet.changed_gaussians == sum(any(row) for row in np.hstack(list(delta.symbols.values())).tolist())
    plain = zstandard.ZstdCompressor(level=19).compress(scene.means[delta.gates != 0].astype("<f2").tobytes())
    assert packet.float16_zstd == len(plain)
    runs, previous = [0], delta.gates[0]
    for gate in delta.gates:
        if gate != previous:
            runs.append(0)
        runs[-1] += 1
        previous = gate
    coded = entropy_by_hand(runs[:-1][0::2]) + entropy_by_hand(runs[:-1][1::2])
    coded += min(sum(entropy_by_hand(c) for c in delta.symbols["means"].T), entropy_by_hand(delta.symbols["means"]))
    assert packet.entropy == pytest.approx(coded / 8, rel=0.2)  # by channel or together, whichever was modelled
    assert packet.coded > packet.entropy


def test_sent_gaussians_are_the_papers_active_ones(tmp_path):
    """Three root cells of 3, 2 and 1 Gaussians, two gates open, one row behind them does not change."""
    with Playback(make_stream(tmp_path / "meta.gss", 1)) as playback:
        meta, scene = playback.meta, playback.state_at(0).map(lambda values: values[:6])
    layout = Layout(np.int32([3, 2, 1]), np.zeros(6, np.uint8), np.float32([1]))
    moves = {"means": np.int32([[1, 0, 0], [0, 0, 0], [0, 2, 0], [0, 0, 3]])}
    delta = Delta((Residual(np.uint8([4, 0, 10]), 10, moves, {"means": 0.02}),))
    key, packet = encode_key(KeyState(scene, layout, meta)), encode_delta(delta, layout, {}, frame=1)
    player, log = decode_packet(decode_packet(None, key.data), packet.data), FrameLog()
    log_packet(log, player, packet)
    found = [log.numbers[name] for name in ("sent_gaussians", "changed_gaussians", "active_gates", "num_gates")]
    assert found == [4, 3, 2, 3]
    summary = summarise([FrameRecord(0), record_of({"frame": 1, **log.numbers})])
    assert (summary.sent, summary.gates_per_sent) == (4 / 6, 2 / 4)


def test_large_tables_are_coded_within_four_percent_of_their_entropy(tmp_path):
    """50,000 Gaussians, a twentieth active, every attribute: the sizes that matter."""
    rng, number = np.random.default_rng(3), 50_000
    widths = {"means": 3, "quats": 4, "scales": 3, "opacities": 1, "sh0": 3}
    scene = Gaussians(
        means=(rng.random((number, 3)) * 4).astype(np.float32),
        quats=rng.normal(size=(number, 4)).astype(np.float32),
        scales=(rng.normal(size=(number, 3)) - 4).astype(np.float32),
        opacities=rng.normal(size=number).astype(np.float32),
        sh0=rng.normal(size=(number, 1, 3)).astype(np.float32),
        shN=np.zeros((number, 0, 3), np.float32),
    )
    with Playback(make_stream(tmp_path / "meta.gss", 1)) as playback:
        meta = playback.meta
    layout = Layout(np.full(number // 5, 5, np.int32), np.zeros(number, np.uint8), np.float32([1]))
    gates = np.repeat(rng.random(number // 50) < 0.05, 10).astype(np.uint8)
    rows = 5 * int(gates.sum())
    symbols = {n: np.rint(rng.laplace(size=(rows, w)) * 2).astype(np.int32) for n, w in widths.items()}
    with StreamWriter.open(tmp_path / "s.gss") as writer:
        writer.append(encode_key(KeyState(scene, layout, meta)))
        delta = Delta((Residual(gates, 1, symbols, dict.fromkeys(widths, 0.01)),))
        writer.append(encode_delta(delta, layout, {}, frame=1))
        writer.append(encode_empty(frame=2))
    stats = stream_stats(tmp_path / "s.gss")
    assert 1 <= stats.efficiency("key") < 1.01
    assert 1 <= stats.efficiency("delta") < 1.04
    assert stats.efficiency("empty") is None
    found = stats.summary()
    assert found["float16_zstd_over_coded"] > 3
    assert found["sent_share"] == pytest.approx(rows / number / 2)


def test_a_key_alone_and_a_damaged_stream(tmp_path):
    path = make_stream(tmp_path / "s.gss", 1)
    found = stream_stats(path).summary()
    assert found["kb_per_frame"] is found["delta_coder_over_entropy"] is found["mbit_per_second"] is None
    data = bytearray(make_stream(tmp_path / "t.gss").read_bytes())
    data[-200] ^= 1
    (tmp_path / "t.gss").write_bytes(data)
    with pytest.raises(PacketError):
        stream_stats(tmp_path / "t.gss")


def test_info_prints_them_and_json_is_json(tmp_path, capsys):
    path = make_stream(tmp_path / "s.gss")
    assert run_command(["info", str(path)]) == 0
    out = capsys.readouterr().out
    for words in ("KB/frame after frame 0", "Mbit/s", "paper's estimate", "times the entropy", "float16", "ms a delta"):
        assert words in out
    assert run_command(["info", str(make_stream(tmp_path / "one.gss", 1))]) == 0
    assert "None" not in capsys.readouterr().out
    assert run_command(["info", str(path), "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert [p["size"] for p in data["packets"]] == [p.size for p in stream_stats(path).packets]
    assert data["summary"]["frames"] == 5


def test_export_and_manifest_commands(tmp_path, capsys):
    path = make_stream(tmp_path / "s.gss")
    assert run_command(["export", str(path), "--format", "ply", "--frames", "1:3", "--out", str(tmp_path / "out")]) == 0
    assert sorted(f.name for f in (tmp_path / "out").iterdir()) == ["000001.ply", "000002.ply"]
    assert "2 files" in capsys.readouterr().out
    assert run_command(["export", str(path), "--format", "manifest", "--out", str(tmp_path / "m")]) == 0
    assert len(json.loads((tmp_path / "m" / "stream.json").read_text())["packets"]) == 5
    capsys.readouterr()
    assert run_command(["export", str(path), "--format", "obj", "--out", str(tmp_path / "no")]) == 2
    assert "'obj' is not one of 'ply', 'spz', 'glb', 'sequence', 'usd', '4dgs'" in capsys.readouterr().err
