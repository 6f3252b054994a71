"""Recipe + catalogue -> live parts. Every part's settings are checked here; all problems come in one error."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

from gsstream.core.errors import InputError, UnknownName
from gsstream.core.kinds import PART_KINDS
from gsstream.core.part import Part
from gsstream.discovery.catalog import Catalog
from gsstream.engine.assembly.checks import Checks, requested_checks
from gsstream.engine.assembly.choose_renderer import Chosen, choose_renderer, construct
from gsstream.engine.assembly.guard import guard
from gsstream.engine.assembly.part_in_use import PartInUse, Where
from gsstream.engine.assembly.recipe_keys import unused_key_messages
from gsstream.engine.assembly.slots import SLOTS, LiveParts
from gsstream.engine.assembly.title import title
from gsstream.recipe.check import join_problems, validate
from gsstream.recipe.document import KeyPath, Origin
from gsstream.recipe.load import ResolvedRecipe
from gsstream.recipe.model import ComponentRef, Recipe
from gsstream.spec import ComponentSpec

BLACK = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Assembly(LiveParts):
    """The live parts of a run.

    Arguments:
        recipe: the recipe with every part's parameters written out and the renderer that was chosen.
        origins: path -> origin of every value that is not a default (for ``recipe.save.save_resolved``).
        distributions: installed distributions that the parts come from.
        checks: how closely the run looks at what parts return; nothing that is sent depends on it.
        title: the method and what was changed of its recipe, for tables and pictures.
        background: colour behind everything: the recipe's. Where that is "auto", black until the encoder has seen
            frame 0.
        note: the GPU that is used, or why one is not; empty where the recipe names the renderer or there is no GPU.
        where: the frame and iteration that errors name.

    Every part is behind a guard (:class:`gsstream.engine.assembly.guard.Guarded`), so no caller has to be careful.
    """

    recipe: Recipe
    origins: Mapping[KeyPath, Origin] = field(default_factory=dict)
    distributions: tuple[str, ...] = ()
    checks: Checks = Checks.FRAME
    title: str = ""
    background: tuple[float, float, float] = BLACK
    note: str = ""
    where: Where = field(default_factory=Where, compare=False, repr=False)

    def __post_init__(self) -> None:
        for slot in SLOTS:
            object.__setattr__(self, slot, guard(slot, getattr(self, slot), self.where, self.checks))

    def part(self, slot: str) -> Part:
        """Return the part of a slot itself, without its guard."""
        part: Part = getattr(self, slot).__wrapped__
        return part

    def use(self, slot: str) -> PartInUse:
        """Return the part of a slot as it is used here: to name it in errors, and to check its values."""
        return PartInUse(slot, self.part(slot), self.where, self.checks)

    @property
    def resolved(self) -> ResolvedRecipe:
        """Recipe and provenance together."""
        return ResolvedRecipe(self.recipe, self.origins)


def assemble(
    resolved: ResolvedRecipe | Recipe,
    catalog: Catalog,
    checks: str | None = None,
    live: Mapping[str, Part] = MappingProxyType({}),
) -> Assembly:
    """Import every named part, or take it from ``live`` (slot -> part), check its parameters, and build it.

    Raises RecipeError with all that is wrong with the recipe, InputError for a level of checks or a live part that does
    not fit, PluginUnavailable for a part whose plugin is in quarantine or that is not what it claims to be.
    """
    level = requested_checks(checks)
    if isinstance(resolved, Recipe):
        resolved = ResolvedRecipe(resolved, {})
    resolved = with_live(resolved, live, catalog)
    problems: list[str] = []
    parts: dict[str, Any] = {}
    refs: dict[str, ComponentRef] = {}
    note = ""
    for slot in SLOTS:
        ref: ComponentRef = getattr(resolved.recipe, slot)
        if slot in live:
            built: Part | None = live[slot]
        elif slot == "renderer" and ref.name == "auto":
            chosen = _choose(ref, resolved, catalog, problems=problems, parts=parts)
            ref = ComponentRef(name=chosen.name) if chosen else ref
            built, note = (chosen.renderer, chosen.note) if chosen else (None, "")
        else:
            built = _build(slot, ref, resolved, catalog=catalog, problems=problems)
        if built is not None:
            parts[slot] = built
            refs[slot] = ComponentRef(name=ref.name, params=built.config.model_dump(mode="json"))
    on_gpu = "renderer" in parts and parts["renderer"].device.type != "cpu"
    if on_gpu and (reason := _processor_only(parts)):
        problems.append(f"renderer {refs['renderer'].name!r} works on a GPU, and {reason}; choose --renderer cpu")
    if "streaming_method" in parts:
        problems += unused_key_messages(resolved.recipe.model_copy(update=refs), parts, resolved)
    join_problems(problems)
    declared = (catalog.entries.get((slot, ref.name)) for slot, ref in refs.items())
    owners = sorted({entry.distribution for entry in declared if entry})
    recipe = resolved.recipe.model_copy(update=refs)
    return Assembly(
        recipe=recipe,
        origins=resolved.origins,
        distributions=tuple(owners),
        checks=level,
        title=title(resolved.recipe, catalog),
        note=note,
        **parts,
        background=BLACK if recipe.background == "auto" else recipe.background,
    )


def with_values(params: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``params`` with the values under dotted keys."""
    out: dict[str, Any] = copy.deepcopy(dict(params))
    for key, value in values.items():
        *above, name = key.split(".")
        section = out
        for step in above:
            section = section.setdefault(step, {})
        section[name] = value
    return out


def _build(
    slot: str, ref: ComponentRef, resolved: ResolvedRecipe, catalog: Catalog, problems: list[str]
) -> Part | None:
    try:
        cls = catalog.resolve(slot, ref.name)
    except UnknownName as error:
        problems.append(f"{resolved.near((slot, 'name')).where}: {slot}.name: {error}")
        return None
    config = validate(cls.Config, ref.params, resolved.near, prefix=(slot, "params"), problems=problems)
    return None if config is None else construct(slot, ref.name, cls, config=config, catalog=catalog)


def _processor_only(parts: Mapping[str, Part]) -> str:
    """Which of these parts cannot work with tensors of a GPU, and why; empty where all can."""
    for slot, part in parts.items():
        if part.processor_only:
            return f"{slot} {type(part).__name__}: {part.processor_only}"
    return ""


def _choose(
    ref: ComponentRef, resolved: ResolvedRecipe, catalog: Catalog, problems: list[str], parts: Mapping[str, Part]
) -> Chosen | None:
    if ref.params:
        where = resolved.near(("renderer", "params", next(iter(ref.params)))).where
        problems.append(f"{where}: renderer.params needs a named renderer, but renderer.name is 'auto'")
        return None
    return choose_renderer(catalog, _processor_only(parts))


def with_live(resolved: ResolvedRecipe, live: Mapping[str, Part], catalog: Catalog) -> ResolvedRecipe:
    """Return the recipe with these parts, slot -> part, in place of the ones it names.

    Raises InputError for a part that does not fit its slot.
    """
    refs = {slot: _reference(slot, part, catalog) for slot, part in live.items()}
    origins = {path: origin for path, origin in resolved.origins.items() if path[0] not in refs}
    origins |= {(slot,): Origin("Python", f"Python: {slot}={ref.name}") for slot, ref in refs.items()}
    return replace(resolved, recipe=resolved.recipe.model_copy(update=refs), origins=origins)


def _reference(slot: str, part: Part, catalog: Catalog) -> ComponentRef:
    """The name and settings of a live part; one that no plugin declares is called ``module:Class``."""
    contract: type[Any] = PART_KINDS[slot].contract_class()
    if not isinstance(part, contract):
        raise InputError(f"{slot}: expected a live {contract.__name__} or the name of one, got {part!r}")
    name = target = f"{type(part).__module__}:{type(part).__qualname__}"
    for (kind, known), entry in catalog.entries.items():
        if kind == slot and isinstance(entry.spec, ComponentSpec) and entry.spec.target == target:
            name = known
    return ComponentRef(name=name, params=part.config.model_dump(mode="json"))
