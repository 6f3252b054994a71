"""``gsstream methods``: the methods that --method takes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, Any

import typer

from gsstream.cli.listing import table
from gsstream.core.errors import InputError
from gsstream.core.kinds import METHOD_SLOTS

if TYPE_CHECKING:
    from gsstream.discovery.catalog import Catalog
    from gsstream.recipe.load import ResolvedRecipe


def methods(
    name: Annotated[str | None, typer.Argument(help="A method to show: its parts and the values it sets.")] = None,
    full: Annotated[
        bool, typer.Option("--full", help="Import the parts (slow): every setting with default, range and meaning.")
    ] = False,
) -> None:
    """List the methods that --method may name, or show one."""
    if name is not None:
        _show(name, full)
        return
    if full:
        raise InputError("--full: expected a method to show in full, e.g. gsstream methods dense --full")
    from gsstream.discovery.catalog import load_catalog

    catalog = load_catalog()
    entries = [catalog.entry("method", name) for name in catalog.names("method")]
    typer.echo(table(("METHOD", "FROM", "SUMMARY"), [(e.spec.name, e.origin, e.spec.summary) for e in entries]))
    for plugin in catalog.quarantine:
        owner = f"{plugin.name!r} ({plugin.distribution})"
        typer.echo(f"warning: plugin {owner} is in quarantine: {plugin.reason}", err=True)


def _show(name: str, full: bool) -> None:
    from gsstream.discovery.catalog import load_catalog
    from gsstream.recipe.load import resolve_recipe

    catalog = load_catalog()
    entry = catalog.entry("method", name)
    resolved = resolve_recipe(name, catalog.recipe_path)
    typer.echo(f"{name} (from {entry.origin}): {entry.spec.summary}\nrecipe: {catalog.recipe_path(name)}\n")
    typer.echo(table(("SLOT", "PART", "FROM", "SUMMARY"), _slots(resolved, catalog)))
    if full:
        heading = ("SETTING", "VALUE", "SET BY", "DEFAULT", "TYPE", "MEANING")
        typer.echo("\n" + table(heading, _everything(resolved, catalog)))
        return
    values = resolved.recipe.model_dump(mode="json")
    settings = []
    for path, origin in resolved.origins.items():
        if path[-1] != "name" and path[0] not in ("method", "schema_version"):
            settings.append((".".join(path), repr(_at(values, path)), origin.label))
    if settings:
        typer.echo("\n" + table(("SETTING", "VALUE", "SET BY"), settings))
    typer.echo(f"\nevery setting with its default and meaning: gsstream methods {name} --full")


def _slots(resolved: ResolvedRecipe, catalog: Catalog) -> Iterator[tuple[str, str, str, str]]:
    """(slot, part, who ships it, what it is)."""
    from gsstream.recipe.model import ComponentRef

    # Slots of parts say nothing about a method that brings a streaming_method of its own.
    own = ("streaming_method",) if resolved.recipe.streaming_method.name != "parts" else METHOD_SLOTS
    for slot, ref in resolved.recipe:
        if isinstance(ref, ComponentRef) and slot in (*own, "renderer"):
            found = catalog.entries.get((slot, ref.name))
            missing = "the fastest that works here" if ref.name == "auto" else "not installed"
            yield slot, ref.name, found.origin if found else "-", found.spec.summary if found else missing


def _everything(resolved: ResolvedRecipe, catalog: Catalog) -> Iterator[tuple[str, ...]]:
    """One row per setting of the recipe and of the parts it names; defaults are marked as such."""
    from gsstream.cli.plugins import setting_rows
    from gsstream.recipe.model import ComponentRef, Recipe

    values = resolved.recipe.model_dump(mode="json")
    refs = {slot: ref for slot, ref in resolved.recipe if isinstance(ref, ComponentRef)}
    for key, kind, default, meaning in setting_rows(Recipe):
        path = tuple(key.split("."))
        if path[0] not in refs:
            yield key, repr(_at(values, path)), resolved.origin(path).label, default, kind, meaning
        elif path[1] == "name":
            ref = refs[path[0]]
            yield key, repr(ref.name), resolved.origin(path).label, default, kind, meaning
            if ref.name in ("auto", "none"):
                continue
            for name, *facts in setting_rows(catalog.resolve(path[0], ref.name).Config):
                inner = (path[0], "params", *name.split("."))
                own_default = facts[1]
                written = inner in resolved.origins
                value = repr(_at(values, inner)) if written else own_default
                label = resolved.origin(inner).label if written else "default"
                yield ".".join(inner), value, label, own_default, facts[0], facts[2]


def _at(values: Mapping[str, Any], path: tuple[str, ...]) -> Any:
    """The value at a path of nested mappings."""
    for key in path:
        values = values[key]
    return values
