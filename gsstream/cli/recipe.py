"""``gsstream recipe``: the recipe of a run, resolved, with the provenance of every value."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(help="Show resolved recipes.", no_args_is_help=True, rich_markup_mode=None)


@app.callback()
def _group() -> None:
    """Show resolved recipes."""


@app.command()
def show(
    method: Annotated[str, typer.Argument(help="Name of a method.")],
    recipe: Annotated[
        list[Path] | None, typer.Option("--recipe", help="Recipe file laid over the method's; repeatable.")
    ] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY.PATH=VALUE", help="Change one value; repeatable.")
    ] = None,
    full: Annotated[
        bool, typer.Option("--full", help="Import the parts (slow): check their settings, show their defaults too.")
    ] = False,
) -> None:
    """Print a method's recipe as YAML, with the provenance of every value."""
    from gsstream.plugins.catalog import load_catalog
    from gsstream.recipe.load import resolve_recipe
    from gsstream.recipe.save import to_yaml

    overrides = [("--set", text) for text in settings or ()]
    catalog = load_catalog()
    resolved = resolve_recipe(method, catalog.recipe_path, recipe or (), overrides)
    if full:
        from gsstream.engine.assemble import assemble

        resolved = assemble(resolved, catalog).resolved
    typer.echo(to_yaml(resolved), nl=False)
