"""The parts that a plan names, and their settings, looked at for all cells before the first of them runs."""

from __future__ import annotations

from gsstream.core.errors import PluginUnavailable, RecipeError
from gsstream.discovery.catalog import Catalog
from gsstream.engine.assembly.assemble import assemble
from gsstream.recipe.check import join_problems
from gsstream_lab.sweep.plan import Cell, Plan


def check_parts(plan: Plan, catalog: Catalog) -> None:
    """Raise RecipeError with every cause for which cells could not even be assembled, and how many those are.

    A part that this machine cannot make is none: the cells that need it fail by themselves, and the others go on.
    """
    causes: dict[str, list[Cell]] = {}
    for cell in plan.cells.values():
        try:
            assemble(cell.resolved, catalog)
        except RecipeError as error:
            causes.setdefault(str(error), []).append(cell)
        except PluginUnavailable:
            continue
    join_problems([f"{_named(cells)}: {cause}" for cause, cells in causes.items()], "the recipes of the cells")


def _named(cells: list[Cell]) -> str:
    more = f" and {len(cells) - 1} more of {len(cells)}" if len(cells) > 1 else ""
    return f"cell {cells[0].label!r}{more}"
