"""Every row of the paper's tables is a recipe that can be assembled; the cheap ones run two frames."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest
from flow_runs import metrics
from gsstream_lab.sweep.config import Scene, read_sweep
from gsstream_lab.sweep.plan import Cell, make_plan

from gsstream.cli.main import run_command
from gsstream.discovery.catalog import Catalog, load_catalog
from gsstream.engine.assembly.assemble import Assembly, assemble
from gsstream.recipe.load import ResolvedRecipe, recipe_hash, resolve_recipe
from gsstream.recipe.model import Recipe
from gsstream.recipe.save import to_yaml

FOLDER = Path(__file__).parents[3] / "configs" / "paper"
#: A recipe that is laid on top of others; alone it is the dense baseline with an active set.
OVERLAY = "candidates.yaml"
#: Recipes, not tables.
RECIPES = {"full.yaml", OVERLAY}
TABLES = sorted(path.stem for path in FOLDER.glob("*.yaml") if path.name not in RECIPES)
#: Rows of other methods, by how they begin.
OTHERS = ("queen-l", "queen-s", "hicom", "3dgstream", "recon-gs")
#: Rows that are one experiment under the names of several tables.
SAME = [
    {
        "components 5-hfp", "structure-sparsity both", "confidence robust", "root-resolution 2-to-8", "log-base 1.5",
        "progressive full", "propagation full", "discretisation full", "weights full", "gradient-noise full",
        "illumination full", "first-frame-noise full", "main-n3dv full", "main-meetroom full", "main-enerf full",
        "first-frame epochs-250", "structure-sparsity-enerf both", "progressive-enerf full", "campus full",
    },
    {"main-n3dv fast", "main-meetroom fast", "main-enerf fast"},
    {"components 1-dense", "structure-sparsity neither", "structure-sparsity-enerf neither"},
    {
        "components 3-regulariser", "structure-sparsity sparsity", "structure-sparsity-enerf sparsity",
        "octree-parts neither", "octree-parts-meetroom neither",
    },
    {"components 4-octree", "octree-parts both", "octree-parts-meetroom both"},
    {"structure-sparsity structure", "structure-sparsity-enerf structure"},
    {"progressive without", "progressive-enerf without"},
    {"octree-parts hierarchy", "octree-parts-meetroom hierarchy"},
    *({f"main-{data} {row}" for data in ("n3dv", "meetroom", "enerf")} for row in OTHERS),
]  # fmt: skip
#: Tables whose rows have other epochs than the paper's budget of 20.
OTHER_EPOCHS = {"edge-orin": 6, "edge": 6, "fast": 10}
TINY = [
    "first_frame.epochs=2",
    "first_frame.max_iterations=20",
    "first_frame.max_points=600",
    "stream.epochs=1",
    "frames=2",
]
CHEAP = [
    "components 1-dense",
    "components 4-octree",
    "structure-sparsity structure",
    "propagation ft-0.80",
    "discretisation binary-released",
    "confidence constant-zero",
    "first-frame-noise noise-30",
]


@pytest.fixture(scope="module")
def catalog() -> Catalog:
    return load_catalog()


@pytest.fixture(scope="module")
def points(catalog: Catalog) -> dict[str, Cell]:
    """ "table row" -> its run on the demo, with what no recording changes."""
    found = {}
    for table in TABLES:
        config = read_sweep(FOLDER / f"{table}.yaml")
        bare = config.model_copy(update={"scenes": [Scene(name="any", uri="demo")], "seeds": [0]})
        plan = make_plan(bare, FOLDER, catalog.recipe_path)
        found |= {f"{table} {point.variant}": point for point in plan.points}
    return found


@pytest.fixture(scope="module")
def rows(points: dict[str, Cell]) -> dict[str, ResolvedRecipe]:
    """ "table row" -> its recipe."""
    return {name: point.resolved for name, point in points.items()}


def recipe_of(resolved: ResolvedRecipe, catalog: Catalog) -> Recipe:
    """What the parts make of the settings."""
    return assemble(resolved, catalog).recipe


def full(catalog: Catalog, *more: Path) -> Assembly:
    return assemble(resolve_recipe(None, catalog.recipe_path, [FOLDER / "full.yaml", *more]), catalog)


def test_every_row_is_assembled(catalog: Catalog, rows: dict[str, ResolvedRecipe]) -> None:
    assert len(TABLES) == 23
    for name, resolved in rows.items():
        recipe = recipe_of(resolved, catalog)
        if name.split()[1].startswith(OTHERS):
            continue
        assert recipe.method == "s2gs-paper", name
        epochs = next((n for key, n in OTHER_EPOCHS.items() if key in name.split()), 20)
        assert recipe.stream.epochs == epochs, f"{name}: the paper's tables share one budget"
        assert recipe.stream.change_threshold == 0.0, f"{name}: the paper's tables know no active set"
    assert full(catalog, FOLDER / OVERLAY).recipe.stream.change_threshold > 0


def test_every_row_is_another_experiment_except_those_that_are_the_same(
    catalog: Catalog, points: dict[str, Cell], rows: dict[str, ResolvedRecipe]
) -> None:
    groups: dict[tuple[str, str], set[str]] = {}
    for name, point in points.items():
        groups.setdefault((recipe_hash(recipe_of(point.resolved, catalog)), point.scene.uri), set()).add(name)
    several = [group for group in groups.values() if len(group) > 1]
    assert sorted(map(sorted, several)) == sorted(map(sorted, SAME))
    assert recipe_hash(full(catalog).recipe) == recipe_hash(recipe_of(rows["components 5-hfp"], catalog))


def test_the_components_build_on_each_other(catalog: Catalog, rows: dict[str, ResolvedRecipe]) -> None:
    """Each row of the component table differs from the one before in what the row says, and the last is the method."""
    names = ["1-dense", "2-ste", "3-regulariser", "4-octree", "5-hfp"]
    found = [recipe_of(rows[f"components {name}"], catalog).model_dump() for name in names]
    changed = [{key for key in a if a[key] != b[key]} for a, b in pairwise(found)]
    assert changed[0] == {"confidence", "gate"}
    assert changed[1] == {"regularizer"}
    assert changed[2] == {"structure", "stream"}  # the stream: progressive training goes by octree level
    assert changed[3] == {"structure", "propagation"}


def test_discrete_gates_differ_in_the_gate_alone(catalog: Catalog, rows: dict[str, ResolvedRecipe]) -> None:
    """Steps against two values with the same noise, and the same without: one thing in each pair."""
    for suffix, noise in (("", "logistic"), ("-without-noise", "none")):
        full, binary = (
            recipe_of(rows[f"discretisation {name}{suffix}"], catalog).model_dump() for name in ("full", "binary")
        )
        assert {key for key in full if full[key] != binary[key]} == {"gate"}
        assert [row["gate"]["name"] for row in (full, binary)] == ["gumbel-sigmoid", "binary-ste"]
        for key, value in (("noise", noise), ("temperature", 0.3), ("clamp_gradient", False)):
            assert full["gate"]["params"][key] == binary["gate"]["params"][key] == value


def test_the_tables_stand_on_the_letter_of_the_paper(catalog: Catalog, rows: dict[str, ResolvedRecipe]) -> None:
    """The base of all tables is the recipe ``s2gs-paper``, noise in the gates and 250 whole passes included."""
    paper = assemble(resolve_recipe("s2gs-paper", catalog.recipe_path), catalog).recipe
    found = full(catalog).recipe
    assert recipe_hash(found) == recipe_hash(paper)
    assert found.gate.params["noise"] == "logistic"
    assert found.stream.change_threshold == 0
    views = 27
    assert found.first_frame.epochs * views <= found.first_frame.max_iterations


#: Root resolution and log base of the paper's scenes (its supplement, table of hyperparameters).
OCTREES = {
    "coffee_martini": (12, 2.0), "flame_salmon_1": (12, 2.0), "cook_spinach": (9, 2.0), "cut_roasted_beef": (9, 2.0),
    "flame_steak": (9, 2.0), "sear_steak": (9, 2.0), "discussion": (8, 1.5), "trimming": (8, 1.5),
    "vrheadset": (8, 1.5), "actor1_4": (9, 1.2), "actor2_3": (9, 1.2), "actor5_6": (9, 1.2),
    "install_ram": (12, 1.5), "pick_blocks": (12, 1.5), "unplug_device": (12, 1.5),
    "children": (12, 2.0), "football": (12, 2.0), "fountain": (12, 2.0),
}  # fmt: skip


def test_every_scene_of_the_paper_has_its_octree_and_three_seeds(catalog: Catalog) -> None:
    seen = set()
    for table in TABLES:
        config = read_sweep(FOLDER / f"{table}.yaml")
        assert config.seeds == [0, 1, 2], table
        for scene in config.scenes:
            found = scene.set.get("structure.root_exponent", 8), scene.set.get("structure.log_base", 1.5)
            assert found == OCTREES[scene.name], f"{table} {scene.name}"
            seen.add(scene.name)
    assert seen == set(OCTREES)


def test_the_octree_of_a_scene_reaches_its_rows_and_leaves_flat_ones_alone(catalog: Catalog) -> None:
    config = read_sweep(FOLDER / "components.yaml")
    one = config.model_copy(update={"seeds": [0], "scenes": config.scenes[:1]})
    points = {point.variant: point.resolved.recipe for point in make_plan(one, FOLDER, catalog.recipe_path).points}
    assert points["5-hfp"].structure.params == {"root_exponent": 12, "log_base": 2.0}
    assert points["1-dense"].structure.params == {}
    assert points["5-hfp"].data.test_cameras == ("cam00",)


@pytest.mark.parametrize("name", CHEAP)
def test_two_frames_of_the_demo(name: str, points: dict[str, Cell], tmp_path: Path) -> None:
    recipe, out = tmp_path / "row.yaml", tmp_path / "out"
    recipe.write_text(to_yaml(points[name].resolved))
    sets = [item for value in TINY for item in ("--set", value)]
    command = ["run", "--source", points[name].scene.uri, "--recipe", str(recipe), "--out", str(out), "--quiet"]
    assert run_command([*command, "--no-pictures", "--scale", "0.5", *sets]) == 0
    later = metrics(out)[1]
    assert later["frame"] == 1
    if name == "confidence constant-zero":
        assert later["active_gates"] == 0
    if name in ("components 1-dense", "structure-sparsity structure"):
        assert later["iterations"] == 8
