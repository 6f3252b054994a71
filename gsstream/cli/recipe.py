"""``gsstream recipe``: the recipe of a run, resolved, with the provenance of every value."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from gsstream.cli import options
from gsstream.core.errors import InputError, PluginUnavailable

if TYPE_CHECKING:
    from gsstream.discovery.catalog import Catalog
    from gsstream.recipe.schema import PartSchema


def recipe(
    method: Annotated[
        str | None, typer.Argument(help="Name of a method; only --schema works without one, for recipes of any.")
    ] = None,
    recipe: options.Recipes = None,
    settings: options.Settings = None,
    full: Annotated[
        bool, typer.Option("--full", help="Import the parts (slow): check their settings, show their defaults too.")
    ] = False,
    schema: Annotated[
        bool, typer.Option("--schema", help="Print a JSON Schema of recipe files in place of the recipe, for editors.")
    ] = False,
) -> None:
    """Print a method's recipe as YAML, with the provenance of every value.

    With --schema: keys, ranges, meanings, and the settings of every installed part. An editor with a YAML language
    server uses a file with it when the first line of a recipe says "# yaml-language-server: $schema=FILE".
    """
    from gsstream.discovery.catalog import load_catalog
    from gsstream.recipe.load import resolve_recipe
    from gsstream.recipe.save import to_yaml

    catalog = load_catalog()
    if schema:
        if recipe or settings or full:
            raise InputError("--schema describes every recipe; --recipe, --set and --full change nothing in it")
        typer.echo(_schema(method, catalog))
        return
    if method is None:
        raise InputError("expected the name of a method, e.g. gsstream recipe dense; 'gsstream methods' lists them")
    resolved = resolve_recipe(method, catalog.recipe_path, recipe or (), options.overrides(settings))
    if full:
        from gsstream.engine.assembly.assemble import assemble

        resolved = assemble(resolved, catalog).resolved
    typer.echo(to_yaml(resolved), nl=False)


def _schema(method: str | None, catalog: Catalog) -> str:
    import json

    from gsstream.recipe.load import resolve_recipe
    from gsstream.recipe.schema import recipe_schema

    resolved = resolve_recipe(method, catalog.recipe_path) if method else None
    return json.dumps(recipe_schema(_part_schemas(catalog), resolved), indent=1, ensure_ascii=False)


def _part_schemas(catalog: Catalog) -> dict[str, dict[str, PartSchema]]:
    """Import every part that a recipe may name; parts whose import fails are listed without their settings."""
    from gsstream.recipe.schema import PartSchema, slots

    found: dict[str, dict[str, PartSchema]] = {slot: {} for slot in slots()}
    for slot in found:
        for name in catalog.names(slot):
            try:
                part = catalog.resolve(slot, name)
                config = part.Config
            except PluginUnavailable as error:
                typer.echo(f"warning: {error}", err=True)
                config = None
            found[slot][name] = PartSchema(catalog.entry(slot, name).spec.summary, config)
    return found
