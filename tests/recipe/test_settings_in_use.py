"""Settings of parts that no YAML of this repository sets: the table may only become shorter."""

from __future__ import annotations

import subprocess
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel

from gsstream.core.kinds import PART_KINDS
from gsstream.discovery.catalog import load_catalog

ROOT = Path(__file__).parents[2]
#: Part -> settings that are in no YAML.
UNSET = {
    "confidence/onnx": "path output pixels floor",
    "confidence/uniform-random": "seed",
    "confidence/view-gradient": "units seed floor",
    "gate/gumbel-sigmoid": "logit_bound",
    "growth/change-gated-copies": "rounds most prune_opacity views score per_cell pixels",
    "growth/copies": "rounds most prune_opacity",
    "motion/hicom": "levels per_cell momentum l1_weight step",
    "motion/keypoints": "keypoints step",
    "motion/recon": "per_anchor levels every momentum l1_weight pixels step rotation_step",
    "motion/rigid": "pixels votes share hold step least",
    "motion/stream3dgs": "levels entries features base width reach box entry_step step",
    "propagation/ft-pruning": "floor",
    "regularizer/expected-sparsity": "reduction motion",
    "renderer/cpu": "cache_mb",
    "renderer/gsplat": "device",
    "renderer/reference": "rows_per_pass",
    "streaming_method/queen": "means.policy means.step quats.policy quats.latent quats.lr scales.policy "
        "scales.latent scales.lr opacities.policy opacities.latent opacities.lr sh0.policy sh0.latent sh0.lr "
        "shN.latent shN.lr gate.temperature gate.lr gate.l0 mask.share growth.every growth.start growth.stop "
        "growth.grad_threshold growth.max_added growth.prune_opacity change.loss change.aggregate "
        "change.dynamic sigma rate",
    # Frame 0 of another stream is taken over as it is where these are equal in both recipes.
    "structure/octree": "max_levels distance_quantile visible_threshold level_rounding anchor color padding gate_level",
    "update/latent": "quats.latent quats.decoder_std scales.latent scales.decoder_std opacities.latent "
        "opacities.decoder_std sh0.latent shN.latent shN.decoder_std",
}  # fmt: skip


def settings_of(model: type[BaseModel], prefix: str = "") -> Iterator[str]:
    """Dotted names of all settings of a part."""
    for name, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            yield from settings_of(field.annotation, f"{prefix}{name}.")
        else:
            yield prefix + name


def keys_of(value: Any, prefix: str = "") -> Iterator[str]:
    """Dotted keys of a YAML document; ``params`` is no part of a name, as in ``--set``."""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from keys_of(inner, prefix if key == "params" else f"{prefix}.{key}")
        return
    yield prefix
    for item in value if isinstance(value, list) else ():
        # An item of a list begins anew: sweeps and tables name settings there.
        yield from keys_of(item, "")


def keys_that_are_set() -> set[str]:
    """``kind.setting`` of every YAML file, recipes and experiments."""
    command = ["git", "ls-files", "*.yaml", "*.yml"]
    found: set[str] = set()
    for name in subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split():
        for document in yaml.safe_load_all((ROOT / name).read_text(encoding="utf-8")):
            for key in keys_of(document):
                words = key.replace(".params.", ".").strip(".").split(".")
                found.update(".".join(words[place:]) for place, word in enumerate(words) if word in PART_KINDS)
    return found


def test_settings_that_no_yaml_sets() -> None:
    """What no recipe and no experiment sets is a constant, unless a user has a reason to set it."""
    catalog, used, unset = load_catalog(), keys_that_are_set(), set()
    for (kind, part), entry in catalog.entries.items():
        if kind not in PART_KINDS or not entry.distribution.startswith("gsstream"):
            continue
        model = getattr(catalog.resolve(kind, part), "Config", None)
        if model is not None:
            unset |= {f"{kind}/{part}.{name}" for name in settings_of(model) if f"{kind}.{name}" not in used}
    known = {f"{part}.{name}" for part, names in UNSET.items() for name in names.split()}
    assert sorted(unset - known) == [], "make it a constant, or set it in a recipe or an experiment that needs it"
    assert sorted(known - unset) == [], "it is set, or gone: take it from the table"
