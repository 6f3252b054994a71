"""What the shipped parts claim: the contract kit checks each claim, and makes no check of one that was taken back."""

from __future__ import annotations

from dataclasses import fields
from math import log
from typing import Any

from gsstream.core.kinds import PART_KINDS
from gsstream.plugins.catalog import load_catalog

#: Part with its default settings -> what it claims beyond the record of its kind; parts of other kinds claim nothing.
CLAIMS: dict[str, dict[str, Any]] = {
    "confidence/error-gradient": {"needs_renderer": True, "floor": 1.0},
    "confidence/error-aware": {"needs_renderer": True, "floor": 1.0, "finds_motion": True},
    "confidence/noise-normalised": {
        "needs_renderer": True, "floor": log(1e-3), "finds_motion": True, "monotone_in_change": True,
    },
    "confidence/uniform": {"brightness": 0.0},
    "confidence/uniform-random": {"floor": log(1e3)},
    "confidence/view-gradient": {
        "needs_renderer": True, "floor": log(1e-3), "finds_motion": True, "monotone_in_change": True,
        "brightness": 2.0,
    },
    "gate/always-open": {},
    "gate/binary-ste": {"stochastic": True, "differentiable": True, "temperature": True},
    "gate/gumbel-sigmoid": {"stochastic": True, "differentiable": True, "temperature": True},
    "loss/cpu": {"takes_bytes": True},
    "loss/reference": {},
    "propagation/ft-pruning": {"idempotent": True, "differentiable": True, "parent_bound": True},
    "propagation/group-max": {"conservative": True, "idempotent": True, "differentiable": True, "normalised": True},
    "propagation/hierarchical-max": {
        "conservative": True, "idempotent": True, "differentiable": True, "normalised": True, "parent_bound": True,
    },
    "propagation/selective-leaf": {
        "conservative": True, "idempotent": True, "differentiable": True, "normalised": True, "parent_bound": True,
    },
    "regularizer/expected-sparsity": {
        "differentiable": True, "weights": ("lambda1", "lambda2"), "gate_terms": ("sparsity",),
    },
    "regularizer/none": {},
    "structure/flat": {"idempotent": True, "local": True, "has_grid": False},
    "structure/octree": {"idempotent": True, "local": True},
}  # fmt: skip
#: Parts that cannot be made from their default settings.
UNBUILT = {"confidence/onnx"}


def test_no_shipped_part_claims_more_or_less_than_here() -> None:
    catalog, found = load_catalog(), {}
    for (kind, part), entry in catalog.entries.items():
        name = f"{kind}/{part}"
        if kind not in PART_KINDS or not entry.distribution.startswith("gsstream") or name in UNBUILT:
            continue
        if PART_KINDS[kind].contract is None or not fields(PART_KINDS[kind].contract_class().traits):
            continue
        claims = catalog.resolve(kind, part)().claims()
        plain = type(PART_KINDS[kind].contract_class().traits)()
        both = {field.name: (getattr(claims, field.name), getattr(plain, field.name)) for field in fields(claims)}
        found[name] = {claim: said for claim, (said, unsaid) in both.items() if said != unsaid}
    assert found == CLAIMS
