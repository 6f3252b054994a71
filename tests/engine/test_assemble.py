"""Recipe + catalogue -> live parts; which slots there are, and what a run calls itself."""

from __future__ import annotations

import dataclasses
import warnings

import pytest
from pydantic import ValidationError

from gsstream.core.errors import InputError, PluginUnavailable, RecipeError
from gsstream.core.kinds import CONTRACTS, METHOD_SLOTS, PART_KINDS
from gsstream.core.part import Part
from gsstream.discovery.builtin import gsstream_components
from gsstream.discovery.catalog import Catalog, load_catalog
from gsstream.discovery.discovery import Discovered
from gsstream.engine.assembly.assemble import Assembly, assemble
from gsstream.engine.assembly.choose_renderer import SlowRendererWarning
from gsstream.engine.assembly.slots import SLOTS
from gsstream.engine.assembly.title import title
from gsstream.parts.backend.reference import ReferenceRenderer
from gsstream.recipe.load import ResolvedRecipe, resolve_recipe
from gsstream.recipe.model import ComponentRef, Recipe
from gsstream.spec import ComponentSpec


@pytest.fixture
def builtin(monkeypatch: pytest.MonkeyPatch) -> Catalog:
    monkeypatch.setenv("GSSTREAM_LOAD_PLUGINS", "")
    return load_catalog()


def resolve(catalog: Catalog, *sets: str) -> ResolvedRecipe:
    overrides = [("--set", item) for item in ("renderer=reference", *sets)]
    return resolve_recipe("dense", catalog.recipe_path, (), overrides)


def test_the_null_parts_assemble(builtin: Catalog) -> None:
    assembly = assemble(resolve(builtin, "structure.resolution=64"), builtin)
    assert isinstance(assembly, Assembly)
    for slot in SLOTS:
        part = assembly.part(slot)
        assert getattr(assembly, slot) == part
        assert type(part) is builtin.resolve(slot, getattr(assembly.recipe, slot).name)
        assert getattr(assembly.recipe, slot).params == part.config.model_dump(mode="json")
    assert assembly.structure.config.resolution == 64
    assert assembly.resolved.origin(("structure", "params", "resolution")).label == "command line"


def test_an_assembled_recipe_assembles_to_the_same(builtin: Catalog) -> None:
    once = assemble(resolve(builtin, "update.means.step=0.5"), builtin)
    twice = assemble(once.recipe, builtin)
    assert twice.recipe == once.recipe
    assert all(getattr(twice, slot) == getattr(once, slot) for slot in SLOTS)
    assert once.recipe.update.params["means"] == {"step": 0.5, "lr": 0.1}, "a section may be given in part"


def test_all_problems_come_in_one_error(builtin: Catalog) -> None:
    sets = ["gate=always-opne", "structure.resoluton=3"]
    sets += ["update.means.stp=1", "update.quats.step=-1", "update.sh0.lr=x"]
    with pytest.raises(RecipeError) as caught:
        assemble(resolve(builtin, *sets), builtin)
    assert str(caught.value).splitlines() == [
        "5 problems in the recipe:",
        "  --set structure.resoluton=3: unknown key 'structure.params.resoluton'; did you mean 'resolution'?",
        "  --set gate=always-opne: gate.name: no gate named 'always-opne'; did you mean 'always-open'?",
        "  --set update.means.stp=1: unknown key 'update.params.means.stp'; did you mean 'step'?",
        "  --set update.quats.step=-1: update.params.quats.step: input should be greater than 0, got -1",
        "  --set update.sh0.lr=x: update.params.sh0.lr: input should be a valid number, got 'x'",
    ]


@pytest.mark.parametrize("left_out", [False, True])
def test_auto_falls_back_to_the_reference_with_one_warning(builtin: Catalog, left_out: bool) -> None:
    alone = load_catalog([plugin for plugin in builtin.plugins if not plugin.left_out])
    with pytest.warns(SlowRendererWarning) as caught:
        assembly = assemble(Recipe(), builtin if left_out else alone)
    assert len(caught) == 1
    message = str(caught[0].message)
    cures = ["let GSSTREAM_LOAD_PLUGINS name"] if left_out else ["C++20 compiler, then:", " install ", "/cpu_render"]
    for part in ("500 times slower", "no renderer named 'cpu'", *cures):
        assert part in message
    assert assembly.recipe.renderer.name == "reference"


def renderer_plugin(target: str) -> Catalog:
    spec = ComponentSpec(kind="renderer", name="cpu", target=target, summary="stands in for the native one")
    plugins = [plugin for plugin in load_catalog().plugins if plugin.name == "builtin"]
    return load_catalog([*plugins, Discovered("cpu_render", "gsstream-cpu-render", "1", (spec,))])


def test_auto_takes_the_cpu_renderer_when_it_works() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assembly = assemble(Recipe(), renderer_plugin("gsstream.parts.backend.reference:ReferenceRenderer"))
    assert assembly.recipe.renderer.name == "cpu"


def test_a_native_module_that_cannot_be_imported() -> None:
    catalog = renderer_plugin("a_native_module_nobody_built:Renderer")
    with pytest.warns(SlowRendererWarning, match="No module named 'a_native_module_nobody_built'"):
        assert assemble(Recipe(), catalog).recipe.renderer.name == "reference"
    with pytest.raises(PluginUnavailable, match=r"renderer 'cpu' \(from gsstream-cpu-render 1\) cannot be used"):
        assemble(Recipe(renderer=ComponentRef(name="cpu")), catalog)


def test_a_wrong_setting_of_the_environment_is_an_error_and_no_reason_to_be_slow(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(self: object, config: object) -> None:
        raise InputError("GSSTREAM_ISA: expected one of {baseline}, got 'mmx'")

    monkeypatch.setattr(ReferenceRenderer, "__init__", refuse)
    with pytest.raises(InputError, match=r"renderer 'cpu' \(from .*\) could not be built: GSSTREAM_ISA: expected one"):
        assemble(Recipe(), renderer_plugin("gsstream.parts.backend.reference:ReferenceRenderer"))


def test_auto_takes_no_settings(builtin: Catalog) -> None:
    with pytest.raises(RecipeError) as caught:
        assemble(resolve(builtin, "renderer=auto", "renderer.threads=2"), builtin)
    assert str(caught.value) == (
        "--set renderer.threads=2: renderer.params needs a named renderer, but renderer.name is 'auto'"
    )


def test_recipes_name_the_parts_of_the_table() -> None:
    named = {slot: ref.name for slot, ref in Recipe() if isinstance(ref, ComponentRef)}
    assert named == {kind.name: kind.default for kind in PART_KINDS.values() if kind.default is not None}


def test_an_assembly_has_a_field_for_every_slot() -> None:
    fields = {field.name for field in dataclasses.fields(Assembly)}
    assert fields >= {*SLOTS, *METHOD_SLOTS}


@pytest.mark.parametrize("kind", CONTRACTS)
def test_contracts_are_abstract_parts(kind: str) -> None:
    contract = PART_KINDS[kind].contract_class()
    assert issubclass(contract, Part)
    assert contract.__abstractmethods__


def test_every_default_part_is_built_in() -> None:
    shipped = {(spec.kind, spec.name) for spec in gsstream_components()}
    assert shipped >= {(slot, PART_KINDS[slot].default) for slot in METHOD_SLOTS}


def test_kinds_that_are_not_in_the_table_are_refused() -> None:
    with pytest.raises(ValidationError, match="'structure', 'confidence'"):
        ComponentSpec(kind="metric", name="x", target="a:B", summary="nothing reads this kind")
    with pytest.raises(TypeError, match="'source' has no contract class"):
        PART_KINDS["source"].contract_class()


#: method, changes, name.
NAMES = (
    ("dense", (), "dense"),
    ("s2gs-fast", ("gate=always-open",), "s2gs-fast + gate=always-open"),
    ("s2gs-fast", ("stream.epochs=3", "gate=always-open"), "s2gs-fast + gate=always-open, stream.epochs=3"),
    ("s2gs-fast", ("gate.temperature=0.123",), "s2gs-fast + gate.temperature=0.123"),
    ("s2gs-fast", ("update.sh0.latent=7",), "s2gs-fast + update.sh0.latent=7"),
    ("dense", ("streaming_method=hold",), "hold"),
    ("hold", ("frames=3", "seed=4", "scale=0.5", "data.train_views=3", "renderer=reference"), "hold"),
    ("dense", tuple(f"first_frame.{key}=7" for key in ("epochs", "max_points", "max_gaussians", "max_iterations")),
     "dense + first_frame.epochs=7, first_frame.max_iterations=7, first_frame.max_points=7 and 1 more"),
)  # fmt: skip


@pytest.mark.parametrize(("method", "changes", "name"), NAMES)
def test_names(method: str, changes: tuple[str, ...], name: str) -> None:
    catalog = load_catalog()
    if ("method", method) not in catalog.entries:
        pytest.skip(f"{method} is not installed")
    resolved = resolve_recipe(method, catalog.recipe_path, (), [("--set", text) for text in changes])
    parts = assemble(resolved, catalog)
    assert parts.title == name
    assert title(parts.recipe, catalog) == name, "every setting of every part is written out"


def test_shipped_methods_bear_their_own_name() -> None:
    catalog = load_catalog()
    for method in catalog.names("method"):
        parts = assemble(resolve_recipe(method, catalog.recipe_path), catalog)
        assert (parts.title, title(parts.recipe, catalog)) == (method, method)


def test_a_method_that_is_not_installed_keeps_its_name() -> None:
    catalog = load_catalog()
    recipe = resolve_recipe("dense", catalog.recipe_path).recipe
    assert title(recipe.model_copy(update={"method": "gone"}), catalog) == "gone"
