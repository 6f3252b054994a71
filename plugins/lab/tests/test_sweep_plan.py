"""A sweep's file -> cells: what is crossed with what, whose setting wins, which runs are the same run."""

from __future__ import annotations

from pathlib import Path

import pytest
from gsstream_lab.sweep.config import Range, SweepConfig, flat_settings, read_sweep
from gsstream_lab.sweep.plan import combinations, make_plan
from hypothesis import given
from hypothesis import strategies as st
from sweep_works import TWO_SEEDS

from gsstream.core.errors import GsstreamError, RecipeError, UnknownName
from gsstream.discovery.catalog import load_catalog

SCENE = "scenes: [{name: a, uri: demo}]\n"


def epochs(plan):
    return [(p.scene.name, p.variant, p.seed, p.resolved.recipe.stream.epochs) for p in plan.points]


def test_a_grid_crosses_scenes_seeds_variants_and_axes(plan_of):
    plan = plan_of(
        "name: g\nscenes: [{name: a, uri: demo}, {name: b, uri: x, frames: 3, scale: 0.5}]\nseeds: [4, 7]\n"
        "variants: [{name: v, method: dense}, {name: w, method: dense, set: {first_frame.lr_factor: 0.5}}]\n"
        "axes: {stream.epochs: [1, 2], near: [0.1, 0.2]}\n"
    )
    assert len(plan.points) == 2 * 2 * 2 * 4 == len(plan.cells)
    assert epochs(plan)[:4] == [("a", "v", 4, n) for n in (1, 1, 2, 2)]
    last = plan.points[-1]
    assert (last.scene.name, last.variant, last.seed, last.axes) == ("b", "w", 7, {"stream.epochs": 2, "near": 0.2})
    recipe = last.resolved.recipe
    assert (recipe.seed, recipe.frames, recipe.scale) == (7, 3, 0.5)
    assert (recipe.first_frame.lr_factor, recipe.near) == (0.5, 0.2)


def test_each_changes_one_axis_at_a_time_and_shares_equal_runs(plan_of):
    plan = plan_of(
        f"name: e\n{SCENE}variants: [{{name: v, method: dense, set: {{stream.epochs: 5}}}}]\nsearch: each\n"
        "axes: {stream.epochs: [1, 5], near: [0.1]}\n"
    )
    assert [dict(p.axes) for p in plan.points] == [{}, {"stream.epochs": 1}, {"stream.epochs": 5}, {"near": 0.1}]
    assert plan.points[0].id == plan.points[2].id, "the variant itself and an axis at its own value are one run"
    assert len(plan.cells) == 3


def test_base_seeds_repeat_the_unchanged_variant_alone(plan_of):
    text = (
        f"name: e\n{SCENE}variants: [{{name: v, method: dense, base_seeds: [1, 2]}}, {{name: w, method: dense}}]\n"
        "search: each\naxes: {near: [0.1, 0.2]}\n"
    )
    found = [(p.variant, p.seed, p.axes.get("near")) for p in plan_of(text).points]
    assert found == [(v, 0, near) for v in "vw" for near in (None, 0.1, 0.2)] + [("v", 1, None), ("v", 2, None)]
    with pytest.raises(RecipeError, match="base_seeds of v"):
        plan_of(text.replace("[1, 2]", "[0]"))
    with pytest.raises(RecipeError, match="search 'grid'"):
        plan_of(text.replace("search: each", "search: grid"))


def test_settings_win_in_the_documented_order(plan_of, tmp_path):
    ours = "base: dense\nstream: {epochs: 2}\nnear: 0.2\nfirst_frame: {lr_factor: 0.2}\nseed: 99\n"
    (tmp_path / "v.yaml").write_text(ours)
    (tmp_path / "s.yaml").write_text("near: 0.3\nfirst_frame: {lr_factor: 0.3, exposure: true}\n")
    text = (
        "name: o\nscenes: [{name: a, uri: demo, recipe: s.yaml, "
        "set: {first_frame.lr_factor: 0.4, stream.rd_lambda: 0.4}}]\n"
        "set: {first_frame.lr_factor: 0.35, stream.rd_lambda: 0.35, codec.trim: 0.35}\n"
        "variants: [{name: v, recipe: v.yaml, set: {stream.rd_lambda: 0.5}}]\naxes: {codec.trim: [0.6]}\n"
    )
    recipe = plan_of(text).points[0].resolved.recipe
    assert (recipe.stream.epochs, recipe.near, recipe.first_frame.lr_factor) == (2, 0.3, 0.4)
    assert (recipe.stream.rd_lambda, recipe.codec.trim) == (0.5, 0.6)
    assert (recipe.seed, recipe.first_frame.exposure) == (0, True)
    origins = plan_of(text).points[0].resolved
    assert origins.origin(("stream", "rd_lambda")).label == "sweep, variant v: set"


def test_a_slot_takes_a_name_a_mapping_and_the_short_form(plan_of):
    plan = plan_of(
        f"name: s\n{SCENE}variants:\n- {{name: x, method: dense, set: {{gate: other, gate.temperature: 0.3}}}}\n"
        "- {name: y, method: dense, set: {gate: {name: other, params: {temperature: 0.3}}}}\n"
    )
    assert {p.resolved.recipe.gate.name for p in plan.points} == {"other"}
    assert [p.resolved.recipe.gate.params for p in plan.points] == [{"temperature": 0.3}] * 2
    assert len(plan.cells) == 1


def test_frame_0_is_shared_exactly_where_it_does_not_vary(plan_of):
    variants = "[{name: v, method: dense}, {name: w, method: dense, set: KEY}]"
    text = f"name: f\n{SCENE}seeds: [0, 1]\nvariants: {variants}\n"
    for key, count in {
        "{stream.epochs: 3}": 2,
        "{stream.rd_lambda: 0.3}": 2,
        "{codec.trim: 0.3}": 2,
        "{codec.key_interval: 3}": 2,
        "{codec.key_rd_lambda: 0}": 4,
        "{codec.first_layer: 1}": 4,
        "{first_frame.lr_factor: 0.1}": 4,
        "{structure: other}": 4,
        "{first_frame.epochs: 3}": 4,
        "{near: 0.2}": 4,
        "{scale: 0.5}": 4,
    }.items():
        plan = plan_of(text.replace("KEY", key))
        assert len(plan.firsts) == count, key
        assert {run.resolved.recipe.frames for run in plan.firsts.values()} == {1}
    structure = text.replace("KEY", "{structure: other}")
    shared = plan_of(structure + "first_frame: {share: scene}\n")
    assert len(shared.firsts) == 2
    assert {run.resolved.recipe.structure.name for run in shared.firsts.values()} == {"flat"}
    one = plan_of(structure + "first_frame: {share: scene, seed: 5}\n")
    assert [run.resolved.recipe.seed for run in one.firsts.values()] == [5]
    assert len(one.cells) == 4, "the cells keep their own seeds"
    assert {p.first for p in plan_of(structure + "first_frame: {share: own}\n").points} == {None}


def test_a_variant_names_whose_frame_0_it_takes_over(plan_of):
    plan = plan_of(
        f"name: f\n{SCENE}seeds: [0, 1]\nfirst_frame: {{share: scene}}\nvariants: [{{name: v, method: dense}}, "
        "{name: w, method: dense, set: {first_frame.prune_error: 0}}, {name: x, method: dense, first_frame: w}]\n"
    )
    assert {(p.variant, plan.frame_0_of(p)) for p in plan.points} == {("v", "v"), ("w", "v"), ("x", "w")}
    assert {(run.of, run.resolved.recipe.first_frame.prune_error) for run in plan.firsts.values()} == {
        ("v", 10.0),
        ("w", 0.0),
    }
    assert {plan.firsts[p.first].seed == p.seed for p in plan.points} == {True}


def test_ids_follow_what_decides_a_run_and_nothing_else(plan_of):
    ids = list(plan_of(TWO_SEEDS).cells)
    assert list(plan_of(TWO_SEEDS.replace("name: two", "name: other\ndescription: text")).cells) == ids
    assert list(plan_of(TWO_SEEDS.replace("name: world", "name: planet")).cells) == ids
    for change in (
        ("frames=2", "frames=3"),
        ("[1, 2]", "[3, 4]"),
        ("seeds: [0, 1]", "seeds: [2, 3]"),
        ("name: two", "name: two\nmeasure: {fps: true}"),
        ("method: dense", "method: dense, set: {near: 0.2}"),
        ("name: two", "name: two\nfirst_frame: {share: own}"),
    ):
        assert not set(plan_of(TWO_SEEDS.replace(*change)).cells) & set(ids), change


@given(st.floats(1e-6, 1e6), st.floats(1.001, 1e6), st.booleans(), st.booleans(), st.integers(0, 5))
def test_a_random_search_draws_inside_and_always_the_same(low, factor, log, integer, seed):
    config = SweepConfig(
        name="r",
        scenes=[{"name": "a", "uri": "demo"}],
        variants=[{"name": "v"}],
        search="random",
        samples=4,
        search_seed=seed,
        axes={"x": Range(low=low, high=low * factor, log=log, integer=integer), "y": [1, 2, 3]},
    )
    drawn = list(combinations(config, config.variants[0]))
    assert drawn == list(combinations(config, config.variants[0]))
    assert len(drawn) == 4
    slack = 0.5 if integer else 0
    assert all(low - slack <= d["x"] <= low * factor + slack and d["y"] in (1, 2, 3) for d in drawn)
    assert all(isinstance(d["x"], int) == integer for d in drawn)


BAD = [
    ("name: x\nvariants: [{name: v}]\n", "'scenes' is missing"),
    (f"name: x\n{SCENE}variants: []\n", "variants"),
    (f"name: x\n{SCENE}variants: [{{name: v, metod: dense}}]\n", "metod"),
    (f"name: x\n{SCENE}variants: [{{name: v}}, {{name: v}}]\n", "same name"),
    (f"name: x\n{SCENE}seeds: [1, 1]\nvariants: [{{name: v}}]\n", "different integers"),
    (f"name: x\n{SCENE}variants: [{{name: v}}]\naxes: {{near: []}}\n", "at least one value"),
    (f"name: x\n{SCENE}variants: [{{name: v}}]\naxes: {{near: [0.1, 0.1]}}\n", "only once"),
    (f"name: x\n{SCENE}variants: [{{name: v}}]\naxes: {{near: {{low: 1, high: 2}}}}\n", "search: random"),
    (f"name: x\n{SCENE}variants: [{{name: v}}]\nsearch: random\nsamples: 3\n", "needs axes"),
    (f"name: x\n{SCENE}variants: [{{name: v}}]\nsearch: random\naxes: {{near: [0.1]}}\n", "samples"),
    (f"name: x\n{SCENE}variants: [{{name: v}}]\nsearch: random\nsamples: 2\n"
     "axes: {near: {low: 0, high: 1, log: true}}\n", "above 0"),
    (f"name: x\n{SCENE}variants: [{{name: v}}]\nfirst_frame: {{share: own, seed: 3}}\n", "shared frame 0"),
    (f"name: x\n{SCENE}variants: [{{name: v, first_frame: w}}]\nfirst_frame: {{share: scene}}\n", "there are .'v'"),
    (f"name: x\n{SCENE}variants: [{{name: v, first_frame: v}}]\n", "share scene; got 'v' and 'exact'"),
    (f"name: x\n{SCENE}variants: [{{name: v}}]\naxes: {{stream.epoch: [1]}}\n", "did you mean 'epochs'"),
    (f"name: x\n{SCENE}variants: [{{name: v}}]\naxes: {{stream.epochs: [0]}}\n", "greater than or equal to 1"),
    (f"name: x\n{SCENE}variants: [{{name: v}}]\naxes: {{'stream..epochs': [1]}}\n", "expected a recipe key"),
    (f"name: x\n{SCENE}variants: [{{name: v, recipe: nowhere.yaml}}]\n", "cannot read"),
    ("name: x\nname: y\n", "given twice"),
    (f"schema_version: '2.0'\nname: x\n{SCENE}variants: [{{name: v}}]\n", "schema_version"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "message"), BAD, ids=range(len(BAD)))
def test_what_is_wrong_is_said_before_anything_runs(plan_of, text, message):
    with pytest.raises(RecipeError, match=message):
        plan_of(text)


def test_an_unknown_method_is_named(plan_of):
    with pytest.raises(UnknownName, match="did you mean 'dense'"):
        plan_of(f"name: x\n{SCENE}variants: [{{name: v, method: dens}}]\n")


OTHER = f"""
name: other
{SCENE}set: {{near: 0.5}}
variants:
  - name: a
    recipe: recipes/one.yaml
    set: {{stream: {{epochs: 3, change_threshold: 4}}, first_frame.lr_factor: 0.5, gate: {{name: always-open}}}}
  - {{name: b, base: other.yaml#a}}
  - {{name: d, base: more.yaml}}
  - {{name: c, method: dense, axes: {{near: [1, 2]}}}}
  - {{name: loop, base: "sweep.yaml#v"}}
"""


def based(folder, plan_of, variant: str):
    (folder / "tables" / "recipes").mkdir(parents=True, exist_ok=True)
    (folder / "tables" / "recipes" / "one.yaml").write_text("base: dense\nfirst_frame: {max_points: 77}\n")
    for name in ("tables/other.yaml", "tables/more.yaml"):
        (folder / name).write_text(OTHER.replace("sweep.yaml", "../sweep.yaml"))
    return plan_of(f"name: s\n{SCENE}variants: [{{{variant}}}]\n")


def test_a_variant_starts_from_one_of_another_file(tmp_path, plan_of):
    plan = based(tmp_path, plan_of, "name: a, base: tables/other.yaml")
    recipe = plan.points[0].resolved.recipe
    assert (recipe.stream.epochs, recipe.stream.change_threshold, recipe.first_frame.lr_factor) == (3, 4, 0.5)
    assert (recipe.first_frame.max_points, recipe.near) == (77, 0.01), "its recipe file, not what its file sets for all"
    assert plan.config.variants[0].base is None
    for base in ("other.yaml#a", "more.yaml#b"):
        renamed = based(tmp_path, plan_of, f"name: v, base: tables/{base}")
        assert renamed.points[0].id == plan.points[0].id
    settings = "{stream.epochs: 5, first_frame: {lr_factor: 0.1}}"
    changed = based(tmp_path, plan_of, f"name: a, base: tables/other.yaml, set: {settings}")
    recipe = changed.points[0].resolved.recipe
    assert (recipe.stream.epochs, recipe.stream.change_threshold, recipe.first_frame.lr_factor) == (5, 4, 0.1)


@pytest.mark.parametrize(
    ("variant", "problem"),
    [
        ("name: z, base: tables/other.yaml", "known: a, b, c, d, loop"),
        ("name: a, base: tables/none.yaml", "cannot read"),
        ("name: c, base: tables/other.yaml", "has axes"),
        ("name: a, base: tables/other.yaml, method: dense", "leave them out"),
        ("name: a, base: tables/other.yaml#", "base"),
        ("name: d, base: tables/other.yaml", "goes in a circle"),
        ("name: v, base: tables/other.yaml#loop", "goes in a circle"),
    ],
)
def test_a_base_that_cannot_be_is_refused(tmp_path, plan_of, variant, problem):
    with pytest.raises(GsstreamError, match=problem):
        based(tmp_path, plan_of, variant)


def test_settings_flatten():
    assert flat_settings({"a.b": 1, "c": {"d.e": {"f": [1]}}}, "x") == {("a", "b"): 1, ("c", "d", "e", "f"): [1]}


ROOT = Path(__file__).parents[3] / "configs"


TABLES = [path for path in (ROOT / "paper").glob("*.yaml") if path.name not in ("full.yaml", "candidates.yaml")]


#: Rows of the paper that are put beside ours without a run: methods that have no implementation here.
QUOTED = {
    "4dgc", "streamstgs", "streamrf", "k-planes", "nerfplayer", "4dgaussians", "grid4d", "stg", "4dgs", "e-d3dgs",
    "ex4dgs",
}  # fmt: skip


@pytest.mark.parametrize("path", sorted([*(ROOT / "sweeps").rglob("*.yaml"), *TABLES]), ids=lambda p: p.stem)
def test_the_sweeps_that_ship_are_sound(path):
    """Their keys, methods and files exist; a sweep of a table has a variant for each row whose method is shipped."""
    from gsstream_lab.report.paper import paper_table

    config = read_sweep(path)
    short = config.model_copy(update={"seeds": config.seeds[:1], "scenes": config.scenes[:1]})
    plan = make_plan(short, path.parent, load_catalog().recipe_path)
    assert len(plan.cells) == len(plan.points), "two points of a table are the same run"
    names = {variant.name for variant in config.variants}
    for table, renamed in config.paper_tables.items():
        rows = set(paper_table(table).rows)
        assert set(renamed) <= rows
        if path.parent.name != "paper":
            continue
        assert rows - QUOTED <= names


def test_scenes_from_a_file_bring_their_recipes_along():
    path = ROOT / "paper" / "discretisation.yaml"
    moved = read_sweep(path, ROOT / "recordings" / "at_hand.yaml")
    assert [scene.name for scene in moved.scenes] == ["pickblocks", "basketball"]
    one = moved.model_copy(update={"seeds": [0], "variants": moved.variants[:1]})
    recipes = [point.resolved.recipe for point in make_plan(one, path.parent, load_catalog().recipe_path).points]
    assert [recipe.first_frame.points for recipe in recipes] == ["sparse", "sweep"]
    assert [recipe.scale for recipe in recipes] == [1.0, 0.5]
