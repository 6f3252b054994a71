"""What this plugin ships, described without importing torch."""

from __future__ import annotations

from gsstream.spec import ComponentSpec, hookimpl


@hookimpl
def gsstream_components() -> list[ComponentSpec]:
    return [
        ComponentSpec(
            kind="confidence",
            name="onnx",
            target="gsstream_onnx_confidence.estimator:OnnxConfidence",
            summary="a change or flow network that you supply as an ONNX file",
        )
    ]
