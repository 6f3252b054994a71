"""``gsstream recipe``: the recipe of a run, resolved, with the provenance of every value."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from gsstream.cli import options

if TYPE_CHECKING:
    from gsstream.plugins.catalog import Catalog
    from gsstream.recipe.schema import PartSchema

app = typer.Typer(
    help="Show resolved recipes; write their schema for editors.", no_args_is_help=True, rich_markup_mode=None
)


@app.callback()
def _group() -> None:
    """Show resolved recipes; write their schema for editors."""


@app.command()
def show(
    method: Annotated[str, typer.Argument(help="Name of a method.")],
    recipe: options.Recipes = None,
    settings: options.Settings = None,
    full: Annotated[
        bool, typer.Option("--full", help="Import the parts (slow): check their settings, show their defaults too.")
    ] = False,
) -> None:
    """Print a method's recipe as YAML, with the provenance of every value."""
    from gsstream.plugins.catalog import load_catalog
    from gsstream.recipe.load import resolve_recipe
    from gsstream.recipe.save import to_yaml

    catalog = load_catalog()
    resolved = resolve_recipe(method, catalog.recipe_path, recipe or (), options.overrides(settings))
    if full:
        from gsstream.engine.assembly.assemble import assemble

        resolved = assemble(resolved, catalog).resolved
    typer.echo(to_yaml(resolved), nl=False)


@app.command()
def schema(
    method: Annotated[
        str | None, typer.Argument(help="Method whose parts and values the file changes; by default any.")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", help="File to write; printed by default.")] = None,
) -> None:
    """Print a JSON Schema of recipe files: keys, ranges, meanings, and the settings of every installed part.

    An editor with a YAML language server uses it when the first line of a recipe file says
    "# yaml-language-server: $schema=FILE".
    """
    import json

    from gsstream.core.errors import OutputError
    from gsstream.plugins.catalog import load_catalog
    from gsstream.recipe.load import resolve_recipe
    from gsstream.recipe.schema import recipe_schema

    catalog = load_catalog()
    resolved = resolve_recipe(method, catalog.recipe_path) if method else None
    text = json.dumps(recipe_schema(_part_schemas(catalog), resolved), indent=1, ensure_ascii=False)
    if out is None:
        typer.echo(text)
        return
    try:
        out.write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise OutputError(f"cannot write {out}: {error}") from error
    typer.echo(f"wrote {out}\nfirst line of a recipe that uses it:  # yaml-language-server: $schema={out}")


def _part_schemas(catalog: Catalog) -> dict[str, dict[str, PartSchema]]:
    """Every part that a recipe may name, imported; those that cannot be are named without their settings."""
    from gsstream.core.errors import PluginUnavailable
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
