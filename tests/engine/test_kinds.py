"""The table of kinds: what has to be written by hand for every slot agrees with it."""

from __future__ import annotations

import dataclasses

import pytest
from pydantic import ValidationError

from gsstream.core.kinds import CONTRACTS, METHOD_SLOTS, PART_KINDS
from gsstream.core.part import Part
from gsstream.engine.assembly.assemble import SLOTS, Assembly
from gsstream.plugins.builtin import gsstream_components
from gsstream.recipe.model import ComponentRef, Recipe
from gsstream.spec import ComponentSpec


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
