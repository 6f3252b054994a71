"""The kinds of parts, in one table. Every list of kinds, slots or contracts is derived from it.

A new kind is one entry here, a room with its contract class, a module of its name in ``gsstream.testing`` with the
checks of the kind and a ``BEHAVIOUR`` for the common checks, and a module of its name in ``gsstream.testing.examples``
with the part that new plugins start from (``use``). A kind that is a slot also gets a field of its name in
``recipe.model.Recipe`` and ``engine.assembly.slots``.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any


@dataclass(frozen=True, slots=True)
class PartKind:
    """One kind of part."""

    name: str  # as recipes, plugins and errors write it
    #: "module:Class" of the abstract base class, as text, so that listing kinds imports no torch; None: there is no
    #: class to inherit from (a source is anything that is called as ``target(uri, scale)``).
    contract: str | None
    slot: bool = False  # a method that is made of parts has one of this kind
    default: str | None = None  # the part that a recipe names by default; None: recipes have no section of this name
    #: The common checks of behaviour (purity, shapes, precision, permutation) are made on it, beside those of
    #: settings and declaration, which every kind with a contract gets.
    behaviour: bool = False
    #: The part fits changes of the scene by itself, in passes that a budget may make fewer: a frame has a phase of the
    #: kind's name for them, and a part that keeps every promise may still spoil the picture.
    fits: bool = False
    #: The options by which a run names such a part, with <name> and <kind>; None: the engine chooses, so a plugin
    #: author has nothing to start from.
    use: str | None = "--set <kind>=<name> --source demo"

    def contract_class(self) -> type[Any]:
        """Import and return the contract itself. Raises TypeError for a kind without one."""
        if self.contract is None:
            raise TypeError(f"the kind {self.name!r} has no contract class to inherit from")
        module, _, name = self.contract.partition(":")
        found: type[Any] = getattr(importlib.import_module(module), name)
        return found


_KINDS = (
    PartKind("structure", "gsstream.parts.structure.base:Structure", slot=True, default="flat", behaviour=True),
    PartKind(
        "confidence", "gsstream.parts.confidence.base:ConfidenceEstimator", slot=True, default="uniform", behaviour=True
    ),
    PartKind(
        "propagation", "gsstream.parts.propagation.base:Propagation", slot=True, default="group-max", behaviour=True
    ),
    PartKind("gate", "gsstream.parts.gate.base:GateSampler", slot=True, default="always-open", behaviour=True),
    PartKind("motion", "gsstream.parts.motion.base:MotionPart", slot=True, default="still", fits=True),
    PartKind("update", "gsstream.parts.update.base:UpdateRule", slot=True, default="additive"),
    PartKind("growth", "gsstream.parts.growth.base:Growth", slot=True, default="none", fits=True),
    PartKind("regularizer", "gsstream.parts.regularizer.base:Regularizer", slot=True, default="none", behaviour=True),
    PartKind("streaming_method", "gsstream.method.base:StreamingMethod", default="parts"),
    PartKind(
        "renderer", "gsstream.parts.backend.base:Renderer", default="auto", use="--set renderer=<name> --source demo"
    ),
    PartKind("source", None, use="--source <name>:"),
)

#: Name -> kind, in the order in which kinds are listed.
PART_KINDS: Mapping[str, PartKind] = MappingProxyType({kind.name: kind for kind in _KINDS})
#: Slots of a method that is made of parts.
METHOD_SLOTS = tuple(name for name, kind in PART_KINDS.items() if kind.slot)
#: Slots whose parts fit changes of the scene by themselves.
FITTING_SLOTS = tuple(name for name, kind in PART_KINDS.items() if kind.fits)
#: Kind -> "module:Class" of its contract, for the kinds that have one.
CONTRACTS: Mapping[str, str] = MappingProxyType({kind.name: kind.contract for kind in _KINDS if kind.contract})
