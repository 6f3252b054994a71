"""A stream's linear decoders as ONNX files, and running such files so that every runtime gives the same numbers."""

from __future__ import annotations

import importlib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsstream.core.errors import InputError, OutputError
from gsstream.core.shapes import FloatArray, IntArray
from gsstream.player.playback import Playback

#: Outputs are rounded to multiples of 2^-OUTPUT_BITS before anything is done with them: runtimes may differ in the last
#: bits of a sum, far below this grid, and encoder and player must not.
OUTPUT_BITS = 16
_OPSET, _IR = 17, 9


def export_decoders(
    stream: str | os.PathLike[str], out: str | os.PathLike[str], *, frames: Sequence[int] | None = None
) -> list[Path]:
    """Write ``FRAME-ATTRIBUTE.onnx`` for every decoder that a frame brings or changes; returns the files.

    A model takes ``symbols`` [A, L] int32, as the packet carries them, and gives ``residual`` [A, D] float32, ungated
    (``gsstream.core.changes.decode_residual``): step and weights are inside. The sum runs channel by channel in the order
    of the format, so a runtime that rounds every operation gives the built-in path's very bits.

    Raises InputError without the package onnx, PacketError for a damaged stream, OutputError when ``out`` cannot be
    written.
    """
    onnx = _package("onnx", "gsstream[export]")
    folder, written = Path(out), []
    with Playback(stream) as playback:
        known: dict[str, bytes] = {}
        for frame in playback.frames if frames is None else frames:
            delta = playback.delta_at(frame)
            for name, weights in ({} if delta is None else delta.decoders).items():
                assert delta is not None
                model = decoder_model(onnx, weights, delta.steps[name]).SerializeToString()
                if known.get(name) != model:
                    written.append(folder / f"{frame:06d}-{name}.onnx")
                    _write(written[-1], model)
                known[name] = model
    return written


def run_decoder(model: str | os.PathLike[str] | bytes, symbols: IntArray, bits: int = OUTPUT_BITS) -> FloatArray:
    """[A, D] float32 output of an ONNX decoder for [A, L] symbols, rounded by :func:`quantise_output`.

    Works for any model with one input [A, L] of int32 and one float32 output, linear or not.

    Raises InputError without onnxruntime, or when the model does not take these symbols.
    """
    runtime = _package("onnxruntime", "gsstream[onnx]")
    data = model if isinstance(model, bytes) else Path(model).read_bytes()
    options = runtime.SessionOptions()
    # One thread and no fusion: a runtime that reorders sums would still be within the grid, but why let it.
    options.intra_op_num_threads = 1
    options.graph_optimization_level = runtime.GraphOptimizationLevel.ORT_DISABLE_ALL
    try:
        session = runtime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
        (entry,) = session.get_inputs()
        (result,) = session.run(None, {entry.name: np.ascontiguousarray(symbols, np.int32)})
    except Exception as error:  # onnxruntime's errors have no common base of their own
        raise InputError(
            f"decoder: expected a model of one int32 input [A, {symbols.shape[1]}] and one float output; onnxruntime "
            f"says: {str(error).splitlines()[0]}"
        ) from error
    return quantise_output(np.asarray(result, np.float32), bits)


def quantise_output(values: FloatArray, bits: int = OUTPUT_BITS) -> FloatArray:
    """float32 values rounded to multiples of 2^-bits, in float64, halves to even. Idempotent."""
    return np.asarray(np.rint(np.asarray(values, np.float64) * 2.0**bits) * 2.0**-bits + 0.0, np.float32)


def decoder_model(onnx: Any, weights: FloatArray, step: float) -> Any:
    """The ONNX model of a linear decoder [L, D]: the operations of ``decode_residual``, one by one."""
    helper, kinds = onnx.helper, onnx.TensorProto
    latents, width = weights.shape
    constants = [onnx.numpy_helper.from_array(np.array(np.float32(step)), "step")]
    nodes = [
        helper.make_node("Cast", ["symbols"], ["numbers"], to=kinds.FLOAT),
        helper.make_node("Mul", ["numbers", "step"], ["latents"]),
    ]
    total = ""
    for channel in range(latents):
        rows = {"first": channel, "last": channel + 1, "axis": 1}
        constants += [onnx.numpy_helper.from_array(np.array([v], np.int64), f"{k}{channel}") for k, v in rows.items()]
        row = np.ascontiguousarray(weights[channel], np.float32)
        constants.append(onnx.numpy_helper.from_array(row, f"W{channel}"))
        column = [f"latents{channel}"]
        nodes.append(helper.make_node("Slice", ["latents", *(f"{k}{channel}" for k in rows)], column))
        nodes.append(helper.make_node("Mul", [*column, f"W{channel}"], [f"term{channel}"]))
        if total:
            nodes.append(helper.make_node("Add", [total, f"term{channel}"], [f"sum{channel}"]))
        total = f"sum{channel}" if total else f"term{channel}"
    nodes.append(helper.make_node("Identity", [total], ["residual"]))
    inputs = [helper.make_tensor_value_info("symbols", kinds.INT32, ["A", latents])]
    outputs = [helper.make_tensor_value_info("residual", kinds.FLOAT, ["A", width])]
    graph = helper.make_graph(nodes, "gsstream decoder", inputs, outputs, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", _OPSET)], producer_name="gsstream")
    model.ir_version = _IR
    onnx.checker.check_model(model)
    return model


def _write(path: Path, data: bytes) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror or error}") from error


def _package(name: str, extra: str) -> Any:
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError(f"decoders as ONNX need {name}: pip install '{extra}'") from error
