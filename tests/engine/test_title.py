"""What a run is called follows from its recipe's values, wherever they were written and however far written out."""

from __future__ import annotations

import pytest

from gsstream.engine.assembly.assemble import assemble
from gsstream.engine.assembly.title import title
from gsstream.plugins.catalog import load_catalog
from gsstream.recipe.load import resolve_recipe

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
