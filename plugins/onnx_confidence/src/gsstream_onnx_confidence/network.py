"""The user's network: two images in, a map of change or of flow out. Opened once per file, run on the CPU."""

from __future__ import annotations

import functools
from pathlib import Path
from typing import Any, Literal

import numpy as np
import onnxruntime

from gsstream.api import InputError, ShapeError

Output = Literal["change", "flow"]
CHANNELS = {"change": 1, "flow": 2}
Array = np.ndarray[Any, np.dtype[np.float32]]


def run_network(path: str, output: Output, previous: Array, current: Array) -> Array:
    """The network's map for two images.

    Returns [channels, H, W]. Raises InputError when the file cannot be used or the network fails, ShapeError when its
    output has another shape, is not finite, or a probability leaves [0, 1].
    """
    file = Path(path)
    if not path or not file.is_file():
        raise InputError(
            f"confidence 'onnx': expected an ONNX file, got path {path!r}; --set confidence.params.path=FILE"
        )
    session = _session(path, file.stat().st_mtime_ns)
    names = [given.name for given in session.get_inputs()]
    if len(names) != 2:
        raise InputError(f"{path}: expected two inputs, previous and current image, got {len(names)} ({names})")
    planes = [np.ascontiguousarray(image.transpose(2, 0, 1)[None], np.float32) for image in (previous, current)]
    try:
        answer = np.asarray(session.run(None, dict(zip(names, planes, strict=True)))[0])
    except Exception as error:  # onnxruntime's errors have no common base of their own
        first = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"{path}: the network failed on images of shape {list(planes[0].shape)}: {first}") from error
    expected = (1, CHANNELS[output], *previous.shape[:2])
    if answer.shape != expected or answer.dtype != np.float32:
        raise ShapeError(
            f"{path}: expected an output float32 {list(expected)} for output={output!r}, got {answer.dtype} "
            f"{list(answer.shape)}; export the network with that size, or set output"
        )
    if not np.isfinite(answer).all():
        raise ShapeError(f"{path}: expected finite values, {int((~np.isfinite(answer)).sum())} are not")
    if output == "change" and (answer.min() < -1e-4 or answer.max() > 1 + 1e-4):
        raise ShapeError(
            f"{path}: expected probabilities in [0, 1], got {answer.min():.4g} to {answer.max():.4g}; export the "
            "network with its last sigmoid"
        )
    result: Array = answer[0]
    return result


@functools.lru_cache(maxsize=4)
def _session(path: str, _changed: int) -> Any:
    """``_changed`` makes a file that was written anew another one."""
    options = onnxruntime.SessionOptions()
    # One thread and no reordering: the same input gives the same bits on one machine.
    options.intra_op_num_threads, options.log_severity_level = 1, 4
    try:
        return onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's errors have no common base of their own
        first = (str(error).splitlines() or [type(error).__name__])[0]
        raise InputError(f"{path}: expected an ONNX model, onnxruntime cannot load it: {first}") from error
