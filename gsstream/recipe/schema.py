"""A JSON Schema of recipe files, for editors: completion, meaning and range of every key while one writes.

A recipe file holds differences, so nothing is required, and a slot may be a bare name (``gate: always-open``). What one
key says about another (``base`` chooses the parts) is not in the schema: ``gsstream recipe`` has the last word.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from gsstream.core.part import PartConfig
from gsstream.recipe.load import ResolvedRecipe
from gsstream.recipe.model import ComponentRef, Recipe

Schema = dict[str, Any]
DIALECT = "https://json-schema.org/draft/2020-12/schema"


@dataclass(frozen=True, slots=True)
class PartSchema:
    """A part in a schema: its summary and its settings; None where the plugin could not be imported."""

    summary: str
    config: type[PartConfig] | None


def slots() -> list[str]:
    """Return the keys of a recipe that name a part."""
    return [name for name, field in Recipe.model_fields.items() if field.annotation is ComponentRef]


def recipe_schema(parts: Mapping[str, Mapping[str, PartSchema]], resolved: ResolvedRecipe | None = None) -> Schema:
    """Return the schema of a recipe file."""
    schema = Recipe.model_json_schema()
    definitions: Schema = schema.pop("$defs")
    definitions.pop(ComponentRef.__name__)
    properties = schema["properties"]
    for slot in slots():
        default = getattr(resolved.recipe, slot).name if resolved else None
        properties[slot] = _slot(slot, properties[slot], parts.get(slot, {}), default=default, definitions=definitions)
    properties["base"] = {
        "type": "string",
        "description": "name of a method, or a file beside this one, that this file changes",
    }
    if resolved is not None:
        _set_defaults(schema, resolved.recipe.model_dump(mode="json"), definitions)
    title = f"gsstream recipe based on the method {resolved.recipe.method}" if resolved else "gsstream recipe"
    whole = {**schema, "$schema": DIALECT, "title": title, "$defs": definitions}
    free: Schema = _optional(whole)
    return free


def _slot(
    slot: str, field: Schema, parts: Mapping[str, PartSchema], default: str | None, definitions: Schema
) -> Schema:
    """A bare name, or {name, params}; the name decides which settings are known."""
    # The default of a slot need not be the name of a part: the default of the renderer is "auto".
    names = list(dict.fromkeys([Recipe.model_fields[slot].default.name, *parts]))
    keys: set[str] = set()
    cases = []
    for name, part in parts.items():
        if part.config is None:
            continue
        own = part.config.model_json_schema()
        keys |= set(own.get("properties", {}))
        settings = _moved(own, f"{slot}.{name}", definitions)
        case: Schema = {"if": {"properties": {"name": {"const": name}}}, "then": {"properties": {"params": settings}}}
        if name != default:
            case["if"]["required"] = ["name"]
        cases.append(case)
    described = {name: part.summary for name, part in parts.items()}
    choice = {
        "description": f"{field.get('description', slot)}: " + "; ".join(f"{n} ({s})" for n, s in described.items()),
        "enum": names,
    }
    unread = any(part.config is None for part in parts.values())
    any_part: Schema = {"type": "object", "description": "the part's own settings"}
    if not unread:
        any_part["propertyNames"] = {"enum": sorted(keys)}
    section = {
        "type": "object",
        "properties": {"name": choice, "params": any_part},
        "additionalProperties": False,
        "allOf": cases,
    }
    return {"description": choice["description"], "anyOf": [choice, section]}


def _moved(own: Schema, place: str, definitions: Schema) -> Schema:
    """A part's schema with its definitions under names of their own among all others."""
    inner = own.pop("$defs", {})
    names = {f"#/$defs/{name}": f"#/$defs/{place}.{name}" for name in inner}
    for name, value in inner.items():
        definitions[f"{place}.{name}"] = _renamed(value, names)
    moved: Schema = _renamed(own, names)
    return moved


def _renamed(value: Any, names: Mapping[str, str]) -> Any:
    if isinstance(value, dict):
        return {k: names[v] if k == "$ref" else _renamed(v, names) for k, v in value.items()}
    return [_renamed(item, names) for item in value] if isinstance(value, list) else value


def _set_defaults(schema: Schema, values: Mapping[str, Any], definitions: Schema) -> None:
    """Put a method's values in the place of the model's defaults."""
    for name, value in values.items():
        field = schema["properties"].get(name)
        if field is None:
            continue
        if "$ref" in field and isinstance(value, dict):
            _set_defaults(definitions[field["$ref"].rpartition("/")[2]], value, definitions)
        field["default"] = value


def _optional(value: Any, within: str = "") -> Any:
    """The same schema with nothing required: a file may say one key of a section alone."""
    if isinstance(value, dict):
        kept = {k: v for k, v in value.items() if k != "required" or within == "if"}
        return {k: _optional(v, k) for k, v in kept.items()}
    return [_optional(item, within) for item in value] if isinstance(value, list) else value
