"""``gsstream methods``: what --method may name."""

from __future__ import annotations

from typing import Annotated

import typer

from gsstream.cli.listing import table

app = typer.Typer(help="List the methods, or show one.", rich_markup_mode=None)


@app.callback(invoke_without_command=True)
def methods(context: typer.Context) -> None:
    """List the methods that --method may name."""
    if context.invoked_subcommand is not None:
        return
    from gsstream.plugins.catalog import load_catalog

    catalog = load_catalog()
    entries = [catalog.entry("method", name) for name in catalog.names("method")]
    typer.echo(table(("METHOD", "FROM", "SUMMARY"), [(e.spec.name, e.origin, e.spec.summary) for e in entries]))
    for plugin in catalog.quarantine:
        owner = f"{plugin.name!r} ({plugin.distribution})"
        typer.echo(f"warning: plugin {owner} is in quarantine: {plugin.reason}", err=True)


@app.command()
def show(name: Annotated[str, typer.Argument(help="Name of a method.")]) -> None:
    """Show a method's parts and the values it sets."""
    from gsstream.plugins.catalog import load_catalog
    from gsstream.recipe.load import resolve_recipe
    from gsstream.recipe.model import ComponentRef

    catalog = load_catalog()
    entry = catalog.entry("method", name)
    resolved = resolve_recipe(name, catalog.recipe_path)
    typer.echo(f"{name} (from {entry.origin}): {entry.spec.summary}\nrecipe: {catalog.recipe_path(name)}\n")
    refs = [(slot, value.name) for slot, value in resolved.recipe if isinstance(value, ComponentRef)]
    rows = []
    for slot, part in refs:
        found = catalog.entries.get((slot, part))
        summary = found.spec.summary if found else "the fastest that works here" if part == "auto" else "not installed"
        rows.append((slot, part, found.origin if found else "-", summary))
    typer.echo(table(("SLOT", "PART", "FROM", "SUMMARY"), rows))
    values = resolved.recipe.model_dump(mode="json")
    settings = []
    for path, origin in resolved.origins.items():
        value = values
        for key in path:
            value = value[key]
        if path[-1] != "name" and path[0] not in ("method", "schema_version"):
            settings.append((".".join(path), repr(value), origin.label))
    if settings:
        typer.echo("\n" + table(("SETTING", "VALUE", "FROM"), settings))
    typer.echo(f"\nevery value: gsstream recipe show {name}")
