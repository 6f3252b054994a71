"""Decoders as ONNX: onnxruntime gives what the built-in path gives, and outputs lie on a grid."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from gsstream.core.delta import Delta, decode_residual
from gsstream.core.errors import InputError
from gsstream.packet import StreamWriter, decode_packet, encode_delta, encode_key, quantise_decoders
from gsstream.player.decoders import decoder_model, export_decoders, quantise_output, run_decoder
from gsstream.player.playback import Playback
from gsstream.testing.packet.checks import tiny_key

onnx = pytest.importorskip("onnx", reason="needs the package onnx (extra export)")
pytest.importorskip("onnxruntime", reason="needs onnxruntime (extra onnx)")


@pytest.mark.parametrize(("latents", "width"), [(1, 1), (4, 3), (6, 4), (8, 24), (64, 45)])
def test_onnxruntime_gives_the_bits_of_the_built_in_path(latents, width):
    rng = np.random.default_rng(latents)
    weights = quantise_decoders({"sh0": rng.normal(size=(latents, width))})["sh0"]
    symbols = np.rint(20 * rng.laplace(size=(500, latents))).astype(np.int32)
    model = decoder_model(onnx, weights, 0.37).SerializeToString()
    ours = decode_residual(symbols, 0.37, weights)
    assert run_decoder(model, symbols, bits=40).tobytes() == ours.tobytes(), "before the grid: the same sums"
    assert run_decoder(model, symbols).tobytes() == quantise_output(ours).tobytes()


def test_no_rows_are_no_rows():
    model = decoder_model(onnx, np.ones((2, 3), np.float32), 1.0).SerializeToString()
    assert run_decoder(model, np.zeros((0, 2), np.int32)).shape == (0, 3)


def test_the_grid_hides_what_runtimes_differ_in():
    values = np.random.default_rng(1).normal(size=1000).astype(np.float32)
    once = quantise_output(values)
    assert np.array_equal(quantise_output(once), once)
    assert np.abs(once - values).max() <= 2.0**-17
    nudged = np.nextafter(once, np.float32(np.inf))  # another order of a sum, an ulp away
    assert np.array_equal(quantise_output(nudged), once)


@pytest.fixture
def stream(tmp_path: Path) -> Path:
    """Decoders of two attributes; that of scales changes in frame 2."""
    rng, key = np.random.default_rng(2), tiny_key()
    path = tmp_path / "s.gss"
    with StreamWriter.open(path) as writer:
        packet = encode_key(key)
        state = decode_packet(None, packet.data)
        writer.append(packet)
        weights = quantise_decoders({"scales": rng.normal(size=(5, 3)), "sh0": rng.normal(size=(4, 3))})
        for frame in (1, 2):
            if frame == 2:
                weights["scales"] = quantise_decoders({"scales": rng.normal(size=(5, 3))})["scales"]
            symbols = {n: rng.integers(-3, 4, (40, len(w))).astype(np.int32) for n, w in weights.items()}
            gates = np.ones(len(key.layout.node_counts), np.uint8)
            delta = Delta(gates, 1, symbols, dict.fromkeys(weights, 0.5), weights)
            packet = encode_delta(delta, state.layout, state.decoders, frame=frame)
            state = decode_packet(state, packet.data)
            writer.append(packet)
    return path


def test_a_streams_decoders_are_written_when_they_change(stream, tmp_path):
    written = export_decoders(stream, tmp_path / "onnx")
    assert [path.name for path in written] == ["000001-scales.onnx", "000001-sh0.onnx", "000002-scales.onnx"]
    with Playback(stream) as playback:
        for path in written:
            delta = playback.delta_at(int(path.name[:6]))
            name = path.stem[7:]
            ours = decode_residual(delta.symbols[name], delta.steps[name], delta.decoders[name])
            assert np.array_equal(run_decoder(path, delta.symbols[name]), quantise_output(ours))


def test_symbols_of_another_width_are_refused(stream, tmp_path):
    path = export_decoders(stream, tmp_path / "onnx")[0]
    with pytest.raises(InputError, match="one int32 input"):
        run_decoder(path, np.zeros((3, 2), np.int32))


@pytest.mark.parametrize(("package", "call"), [("onnx", export_decoders), ("onnxruntime", run_decoder)])
def test_a_missing_package_is_named(stream, tmp_path, monkeypatch, package, call):
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(InputError, match=f"need {package}: pip install"):
        call(stream, tmp_path / "x") if call is export_decoders else call(b"", np.zeros((1, 1), np.int32))
