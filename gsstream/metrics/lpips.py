"""LPIPS (Zhang et al. 2018) by a network the user supplies as an ONNX file; gsstream ships no weights."""

from __future__ import annotations

import importlib
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gsstream.core.errors import InputError, ShapeError
from gsstream.core.install_hints import install_extra, page
from gsstream.core.shapes import FloatArray
from gsstream.metrics.picture_quality import check_pair

#: Metadata key of the ONNX file that says where the range of its inputs begins.
RANGE_KEY = "gsstream.lpips.range"

#: Lower end of the inputs' range -> the variant, as tables name it. The upper end is 1.
RANGES = {
    "-1": "inputs in [-1, 1] (lpips package)",
    "0": "inputs in [0, 1] (3dgs, as most splatting papers)",
}


class OnnxLpips:
    """A distance of two images, computed by an ONNX model on the CPU.

    The model has two float32 inputs [1, 3, H, W] (image, then target) and one float32 output of a single element. The
    constants inside LPIPS assume [-1, 1]; splatting papers (3DGS, Kerbl 2023, and those that took over its tool) pass
    [0, 1], which gives other numbers. So the lower end of the range is never guessed: ``range_from`` ("-1" or "0"),
    else the file's metadata say it. ``variant`` names file and range. Raises InputError for a file that breaks this.
    """

    def __init__(self, path: str | os.PathLike[str], range_from: str | None = None) -> None:
        self.path = Path(path)
        self._session = _open(self.path)
        self._inputs = _input_names(self.path, self._session.get_inputs())
        _check_output(self.path, self._session.get_outputs())
        metadata = self._session.get_modelmeta().custom_metadata_map
        self._range = _known_range(self.path, range_from, metadata.get(RANGE_KEY))
        self.variant = f"LPIPS of {self.path.name}, {RANGES[self._range]}"

    def __call__(self, image: FloatArray, target: FloatArray) -> float:
        """Distance of two [H, W, 3] images in [0, 1]; 0 for equal ones, larger is worse. Nothing is clamped here.

        Raises ShapeError when the shapes disagree, InputError when the model refuses this size or its answer is not
        one finite number.
        """
        check_pair(image, target)
        given = {name: self._prepared(v) for name, v in zip(self._inputs, (image, target), strict=True)}
        size = f"{image.shape[1]} x {image.shape[0]}"
        try:
            (output,) = self._session.run(None, given)
        except Exception as error:  # onnxruntime's errors have no common base of their own
            raise InputError(
                f"{self.path}: the model failed on images of {size}: {_first_line(error)}; export it with dynamic "
                "height and width"
            ) from error
        value = np.asarray(output)
        if value.size != 1:
            raise ShapeError(
                f"{self.path}: expected one number for a pair of images, got an output of shape {list(value.shape)} "
                f"for images of {size}; export the mean over pixels (spatial=False)"
            )
        distance = float(value.reshape(()))
        if not np.isfinite(distance):
            raise InputError(f"{self.path}: expected a finite distance, got {distance} for images of {size}")
        return distance

    def _prepared(self, image: FloatArray) -> FloatArray:
        planes = np.ascontiguousarray(np.asarray(image, np.float32).transpose(2, 0, 1)[None])
        return planes if self._range == "0" else 2 * planes - 1


def _open(path: Path) -> Any:
    try:
        runtime = importlib.import_module("onnxruntime")
    except ImportError as error:
        raise InputError(f"LPIPS by {path} needs onnxruntime: {install_extra('onnx')}") from error
    if not path.is_file():
        raise InputError(f"no ONNX file at {path}; {page('howto/lpips.md')} says how to make one")
    options = runtime.SessionOptions()
    options.log_severity_level = 4  # onnxruntime raises what goes wrong; its log would only repeat that
    try:
        return runtime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's errors have no common base of their own
        raise InputError(f"{path}: expected an ONNX model, onnxruntime cannot load it: {_first_line(error)}") from error


def _input_names(path: Path, inputs: Sequence[Any]) -> tuple[str, str]:
    """Names of image and target."""
    if len(inputs) != 2:
        got = ", ".join(repr(i.name) for i in inputs)
        raise InputError(f"{path}: expected a model of two inputs, image and target, got {len(inputs)} ({got})")
    for given in inputs:
        fits = len(given.shape) == 4 and _may_be(given.shape[0], 1) and _may_be(given.shape[1], 3)
        if not fits or given.type != "tensor(float)":
            raise InputError(
                f"{path}: expected input {given.name!r} to be float32 [1, 3, H, W], got {given.type} {given.shape}"
            )
    return inputs[0].name, inputs[1].name


def _check_output(path: Path, outputs: Sequence[Any]) -> None:
    if len(outputs) != 1:
        raise InputError(f"{path}: expected a model of one output, the distance, got {len(outputs)}")
    (only,) = outputs
    if only.type != "tensor(float)" or not all(_may_be(length, 1) for length in only.shape or ()):
        raise InputError(
            f"{path}: expected output {only.name!r} to be one float32 number, got {only.type} {only.shape}; "
            "export the mean over pixels (spatial=False)"
        )


def _known_range(path: Path, stated: str | None, written: str | None) -> str:
    known = stated if stated is not None else written
    where = "the option" if stated is not None else f"its metadata key {RANGE_KEY}"
    if known is None:
        raise InputError(
            f"{path} does not say which range its inputs have: set its metadata key {RANGE_KEY}, or --lpips-range, to "
            "-1 ([-1, 1], lpips package) or 0 ([0, 1], 3dgs)"
        )
    if known not in RANGES:
        raise InputError(f"{path}: expected -1 or 0 as the lower end of its inputs, got {known!r} from {where}")
    return known


def _may_be(length: int | str | None, wanted: int) -> bool:
    """A length that is not a number is dynamic."""
    return not isinstance(length, int) or length == wanted


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
