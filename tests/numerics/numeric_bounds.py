"""The bounds of every stage's worst relative error against float64: held by the tests, printed in the page."""

from __future__ import annotations

from typing import NamedTuple


class Bound(NamedTuple):
    """``limit``: largest relative error allowed. ``relative_to``: what the error is divided by."""

    limit: float
    relative_to: str


BOUNDS: dict[str, Bound] = {
    "cameras": Bound(1e-12, "largest coordinate of a camera centre"),
    "projection": Bound(3e-6, "largest image coordinate; entries of the conics by the largest"),
    "spherical harmonics": Bound(2e-6, "largest colour"),
    "compositing": Bound(2e-6, "largest pixel value"),
    "image (cpu)": Bound(2e-5, "largest pixel value"),
    "image (reference)": Bound(5e-6, "largest pixel value"),
    "image (numpy player)": Bound(1e-6, "largest pixel value"),
    "gradients (cpu)": Bound(2e-5, "largest gradient of the attribute"),
    "gradients (reference)": Bound(1e-4, "largest gradient of the attribute"),
    "screen gradient (cpu)": Bound(2e-5, "largest screen gradient"),
    "loss value (cpu)": Bound(2e-6, "the loss"),
    "loss value (reference)": Bound(1e-5, "the loss"),
    "loss gradient (cpu)": Bound(1e-4, "largest gradient of a pixel"),
    "loss gradient (reference)": Bound(2e-4, "largest gradient of a pixel"),
    "view-space gradient difference": Bound(2e-5, "largest gradient difference"),
    "robust normalisation": Bound(1e-14, "each logit, or 1"),
    "propagation": Bound(0.0, "exact"),
    "gate gradient": Bound(1e-6, "each gradient, times its logit / temperature where that is above 1"),
    "gate noise": Bound(1e-6, "each draw, or 1"),
    "open probability": Bound(1e-6, "each probability, times its margin where that is above 1"),
    "rounding of gates": Bound(0.0, "exact"),
    "regulariser": Bound(2e-7, "the term"),
    "decoders": Bound(2e-6, "largest change of the attribute"),
    "application of a delta": Bound(2e-6, "largest value of the attribute"),
    "rate": Bound(1e-4, "largest gradient"),
    "quantiser": Bound(0.5, "one step of the grid"),
    "coder": Bound(0.0, "exact"),
    "octree keys": Bound(0.0, "exact"),
    "octree anchors": Bound(1e-6, "side of the cube"),
    "optimiser (cpu)": Bound(1e-5, "largest movement"),
    "optimiser (reference)": Bound(1e-5, "largest movement"),
}
