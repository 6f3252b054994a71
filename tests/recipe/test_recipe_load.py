"""Layers of a recipe: precedence, provenance, messages."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from gsstream.core.errors import RecipeError, UnknownName
from gsstream.recipe.document import NAMES
from gsstream.recipe.load import ResolvedRecipe, load_recipe, recipe_hash, resolve_recipe
from gsstream.recipe.model import Recipe
from gsstream.recipe.save import save_resolved, to_yaml, values_to_yaml

METHOD = """\
# a method
gate: {name: soft, params: {temperature: 0.3, levels: 10}}
stream:
  epochs: 20
codec: {first_layer: 0.1}
"""


@pytest.fixture
def lab(tmp_path: Path):
    """Writes files, and resolves with the methods found as NAME.method.yaml."""

    class Lab:
        def write(self, name: str, text: str) -> Path:
            path = tmp_path / name
            path.write_text(text, encoding="utf-8")
            return path

        def find(self, name: str) -> Path:
            path = tmp_path / f"{name}.method.yaml"
            if not path.exists():
                raise UnknownName("method", name, ["soft"])
            return path

        def resolve(self, method: str | None = "soft", text: str | None = None, *sets: str) -> ResolvedRecipe:
            files = () if text is None else (self.write("run.yaml", text),)
            return resolve_recipe(method, self.find, files, [("--set", item) for item in sets])

        def refuse(self, text: str | None, *sets: str, method: str | None = "soft") -> str:
            with pytest.raises(RecipeError) as caught:
                self.resolve(method, text, *sets)
            return str(caught.value).replace(f"{tmp_path}/", "")

    lab = Lab()
    lab.write("soft.method.yaml", METHOD)
    return lab


def label(resolved: ResolvedRecipe, path: str) -> str:
    return resolved.origin(tuple(path.split("."))).label


def test_each_layer_overrides_the_one_below_and_is_named(lab, tmp_path: Path) -> None:
    resolved = lab.resolve("soft", "stream:\n  epochs: 7\ncodec:\n  first_layer: 0.5\n", "codec.first_layer=0.75")
    recipe = resolved.recipe
    assert (recipe.method, recipe.gate.name) == ("soft", "soft")
    assert (recipe.stream.epochs, recipe.codec.first_layer) == (7, 0.75)
    assert recipe.gate.params == {"temperature": 0.3, "levels": 10}
    assert label(resolved, "seed") == "default"
    assert label(resolved, "gate.params.levels") == "method soft"
    assert label(resolved, "stream.epochs") == f"file {tmp_path}/run.yaml:2"
    assert label(resolved, "codec.first_layer") == "command line"
    assert recipe.first_frame == Recipe().first_frame


def test_slot_shorthands(lab) -> None:
    assert lab.resolve("soft", "structure: octree\n").recipe.structure.name == "octree"
    resolved = lab.resolve("soft", None, "gate.temperature=1e-3", "update.means.step=0.5")
    assert resolved.recipe.gate.params == {"temperature": 0.001, "levels": 10}
    assert resolved.recipe.update.params == {"means": {"step": 0.5}}
    assert lab.resolve("soft", None, "gate.name=hard").recipe.gate.name == "hard"


@pytest.mark.parametrize("order", [0, 1])
def test_another_part_drops_the_settings_of_the_former(lab, order: int) -> None:
    sets = ["gate=hard", "gate.sharpness=2"]
    resolved = lab.resolve("soft", None, *(sets if order == 0 else sets[::-1]))
    assert resolved.recipe.gate.model_dump() == {"name": "hard", "params": {"sharpness": 2}}
    same = lab.resolve("soft", None, "gate=soft", "gate.levels=1")
    assert same.recipe.gate.params == {"temperature": 0.3, "levels": 1}


def test_base_method_and_base_file(lab) -> None:
    lab.write("common.yaml", "base: soft\nseed: 3\nstream: {epochs: 5}\n")
    resolved = lab.resolve(None, "base: common.yaml\nstream: {epochs: 6}\n")
    assert (resolved.recipe.method, resolved.recipe.seed, resolved.recipe.stream.epochs) == ("soft", 3, 6)
    assert resolved.recipe.gate.name == "soft"
    lab.write("quick.method.yaml", "base: soft\nstream: {epochs: 1}\n")
    quick = lab.resolve("quick")
    assert (quick.recipe.method, quick.recipe.stream.epochs, quick.recipe.gate.name) == ("quick", 1, "soft")
    assert (label(quick, "stream.epochs"), label(quick, "gate.name")) == ("method quick", "method soft")
    assert lab.resolve(None, "method: quick\n").recipe.stream.epochs == 1


def test_several_files_lie_on_each_other(lab) -> None:
    first = lab.write("ablation.yaml", "base: soft\nseed: 3\nstream: {epochs: 5}\n")
    second = lab.write("recording.yaml", "stream: {epochs: 6}\nscale: 0.5\n")
    for method in (None, "soft"):
        resolved = resolve_recipe(method, lab.find, [first, second], [("--set", "scale=0.25")])
        recipe = resolved.recipe
        assert (recipe.method, recipe.seed, recipe.stream.epochs, recipe.scale) == ("soft", 3, 6, 0.25)
        assert recipe.gate.name == "soft"
        assert label(resolved, "stream.epochs") == f"file {second}:1"
    # The other way round the method's file would undo the first file's values: refused, not guessed.
    with pytest.raises(RecipeError, match=r"ablation\.yaml belongs to the method 'soft', .*: give it first"):
        resolve_recipe(None, lab.find, [second, first])
    with pytest.raises(RecipeError, match="belongs to the method 'hard'"):
        resolve_recipe("soft", lab.find, [second, lab.write("saved.yaml", "method: hard\n")])


def test_another_part_in_a_later_file_drops_the_settings_of_an_earlier_one(lab) -> None:
    first = lab.write("a.yaml", "gate: {params: {levels: 1}}\n")
    second = lab.write("b.yaml", "gate: hard\n")
    assert resolve_recipe("soft", lab.find, [first]).recipe.gate.params == {"temperature": 0.3, "levels": 1}
    assert resolve_recipe("soft", lab.find, [first, second]).recipe.gate.model_dump() == {"name": "hard", "params": {}}


def test_no_method_means_dense(lab) -> None:
    lab.write("dense.method.yaml", "")
    assert lab.resolve(None, "seed: 4\n").recipe == Recipe(seed=4)


def test_messages(lab) -> None:
    text = "seed: 1\ngate:\n  params:\n    temprature: 1\nstrem:\n  epochs: 2\n  other: 3\ncodec:\n  key_evry: 1\n"
    # A part's own settings are its own business until it is assembled: temprature passes here.
    assert lab.refuse(text) == (
        "2 problems in the recipe:\n"
        "  run.yaml:5:1: unknown key 'strem'; did you mean 'stream'?\n"
        "  run.yaml:9:3: unknown key 'codec.key_evry'; did you mean 'key_interval'?"
    )
    assert lab.refuse("gate: {temperature: 1}") == (
        "run.yaml:1:8: unknown key 'gate.temperature'; a part's own settings go under 'gate.params'"
    )
    assert lab.refuse("stream: 3\n").startswith("run.yaml:1:1: 'stream' is a section with the keys epochs, ")
    assert lab.refuse("seed: {a: 1}") == "run.yaml:1:1: 'seed' is a single value; got keys below it"
    assert lab.refuse("gate: {params: 3}") == "run.yaml:1:8: 'gate.params' holds the part's settings by name; got 3"
    assert (
        lab.refuse(None, "stream.epoch=3") == "--set stream.epoch=3: unknown key 'stream.epoch'; did you mean 'epochs'?"
    )
    assert lab.refuse("codec:\n  first_layer: 3.0\n") == (
        "run.yaml:2:3: codec.first_layer: input should be less than or equal to 1, got 3.0"
    )
    assert lab.refuse("schema_version: '2.3'\n") == (
        "run.yaml:1:1: built for recipe schema 2.3, this gsstream speaks 2.0: upgrade gsstream"
    )
    assert lab.refuse("schema_version: '1.0'\n") == (
        "run.yaml:1:1: built for recipe schema 1.0, this gsstream speaks 2.0: write its keys as 'gsstream recipe "
        "METHOD' shows them, and set schema_version to that number"
    )


def test_unknown_keys_and_bad_values_come_together(lab) -> None:
    message = lab.refuse("codec: {first_layer: 2}\nsed: 1\n", "frames=0")
    assert message.startswith("3 problems in the recipe:\n")
    for part in ("run.yaml:1:9: codec.first_layer", "run.yaml:2:1: unknown key 'sed'", "--set frames=0: frames: input"):
        assert part in message


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("seed: '3'", "run.yaml:1:1: seed: input should be a valid integer, got '3'"),
        ("seed: true", "run.yaml:1:1: seed: input should be a valid integer, got True"),
        ("seed: 1.0", "run.yaml:1:1: seed: input should be a valid integer, got 1.0"),
        ("scale: .nan", "run.yaml:1:8: expected a finite number, got .nan"),
        ("scale: .inf", "run.yaml:1:8: expected a finite number, got .inf"),
        ("seed: 1\nseed: 2", "run.yaml:2:1: key 'seed' is given twice, first in line 1"),
        ("codec:\n  trim: 0\n  trim: 0", "run.yaml:3:3: key 'codec.trim' is given twice, first in line 2"),
        ("3: 4", "run.yaml:1:1: a key must be a word, got '3'"),
        ("- a", "run.yaml:1:1: a recipe maps keys to values; got a single value or a list"),
        ("method: 2020-01-01", "run.yaml:1:9: '2020-01-01' reads as a date; quote it if a word is meant"),
        ("a: &x 1\nb: *x", "run.yaml:1:4: anchors and aliases (&x) are not used in recipes; write the value out"),
        ("codec: {first_layer: 0.1", "run.yaml:1:25: not valid YAML: expected ',' or '}', but got '<stream end>'"),
        ("method: hard", "run.yaml:1:1: run.yaml belongs to the method 'hard', but --method says 'soft': leave "),
        ("base: other.yaml", "run.yaml:1:1: base: there is no file other.yaml"),
        ("base: run.yaml", "run.yaml:1:1: base: goes in a circle: "),
        ("base: there.yaml", "there.yaml:1:1: base: goes in a circle: run.yaml -> there.yaml -> run.yaml"),
        ("base: chicken", "egg.method.yaml:1:1: base: goes in a circle: "),
        ("base: 3", "run.yaml:1:1: base: expected the name of a method or a file, got 3"),
    ],
)
def test_refused_files(lab, text: str, message: str) -> None:
    lab.write("there.yaml", "base: run.yaml")
    lab.write("chicken.method.yaml", "base: egg")
    lab.write("egg.method.yaml", "base: chicken")
    assert lab.refuse(text).startswith(message)


@pytest.mark.parametrize("item", ["seed", "=3", "seed=", "a..b=1", ".seed=1", "seed= "])
def test_malformed_overrides(lab, item: str) -> None:
    assert lab.refuse(None, item).startswith(f"--set {item}: expected KEY.PATH=VALUE")


def test_yaml_is_version_1_2(lab) -> None:
    resolved = lab.resolve(
        "soft", "first_frame: {lr_means: 1e-3}\ngate: {name: on, params: {x: [0, 1, 0.5]}}\nframes: null\n"
    )
    assert resolved.recipe.first_frame.lr_means == 0.001
    assert resolved.recipe.gate.name == "on"
    assert resolved.recipe.gate.params == {"x": [0, 1, 0.5]}


def test_the_last_of_two_options_counts(lab) -> None:
    assert lab.resolve("soft", None, "seed=1", "seed=2", "seed=3").recipe.seed == 3


def test_hash_ignores_provenance_and_sees_every_value(lab) -> None:
    base = recipe_hash(lab.resolve("soft", "seed: 5\n").recipe)
    assert base == recipe_hash(lab.resolve("soft", None, "seed=5").recipe)
    for change in ("seed=6", "gate.levels=11", "near=0.02", "data.leak=points", "codec.first_layer=0.1000001"):
        assert recipe_hash(lab.resolve("soft", "seed: 5\n", change).recipe) != base


json_values = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(2**60), 2**60)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(min_size=1, max_size=5), inner, max_size=3),
    max_leaves=6,
)


@example(params={"0": ["?0"]})
@example(params={"0": [{"?0": "- a"}, "yes", "", " x", "#", "1e3", "null"]})
@settings(max_examples=50, deadline=None)
@given(params=st.dictionaries(st.text(min_size=1, max_size=6), json_values, max_size=4))
def test_saved_recipes_read_back_equal(params: dict, tmp_path_factory: pytest.TempPathFactory) -> None:
    """Only the two sections that are no defaults are written: ruamel takes a third of a second for all of them."""
    values = {"gate": {"name": "x", "params": params}, "first_frame": {"lr_means": 1e-7}}
    recipe = Recipe.model_validate(values)
    path = tmp_path_factory.mktemp("saved") / "recipe.yaml"
    path.write_text(values_to_yaml(values, ResolvedRecipe(recipe, {})), encoding="utf-8")
    assert load_recipe(path).recipe == recipe


def test_a_whole_saved_recipe_reads_back_equal(lab, tmp_path: Path) -> None:
    resolved = lab.resolve("soft", "seed: 9\n", "gate.levels=2")
    save_resolved(tmp_path / "recipe.yaml", resolved)
    assert load_recipe(tmp_path / "recipe.yaml").recipe == resolved.recipe


@settings(max_examples=100, deadline=None)
@given(text=st.text(alphabet=st.sampled_from(list("ab:{}[],-#&*!|>'\"\n\t 01.%@seed\x00é")), max_size=40))
def test_any_text_is_a_recipe_or_a_recipe_error(text: str, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.mktemp("fuzz") / "run.yaml"
    path.write_text(text, encoding="utf-8")
    try:
        outcome = str(load_recipe(path).recipe.schema_version)
    except RecipeError as error:  # any other exception fails the test
        outcome = str(error)
    assert outcome == "2.0" or "run.yaml" in outcome


def test_deep_nesting_and_foreign_bytes_are_refused(lab, tmp_path: Path) -> None:
    assert "not valid YAML: nested too deeply" in lab.refuse("a: " + "[" * 1500)
    (tmp_path / "bytes.yaml").write_bytes(b"\xff\xfe\x00seed")
    with pytest.raises(RecipeError, match=r"cannot read the recipe .*bytes\.yaml"):
        load_recipe(tmp_path / "bytes.yaml")


def test_provenance_stands_beside_every_value(lab) -> None:
    lines = to_yaml(lab.resolve("soft", "seed: 9\n", "gate.levels=2")).splitlines()
    assert "seed: 9" in lines[4]
    for line in lines[2:]:
        value = line.partition(":")[2]
        assert (" # " in line) == bool(value.strip()), f"a value without provenance, or a section with one: {line!r}"
    (levels,) = [line for line in lines if "levels: 2" in line]
    assert levels.endswith("# command line")


NAMED = ("[0001, 12, null, cam]", '["0001", \'12\', "null", cam]', "\n  - 0001\n  - 12\n  - null\n  - cam")


@pytest.mark.parametrize("written", NAMED)
def test_names_of_cameras_are_what_is_written(lab, written: str) -> None:
    empty, file = lab.write("soft.yaml", ""), lab.write("r.yaml", f"data:\n test_cameras: {written}")
    for files, sets in (([file], []), ([], [("--set", f"data.test_cameras={written}")])):
        data = resolve_recipe("soft", lambda _: empty, files, sets).recipe.data
        assert data.test_cameras == ("0001", "12", "null", "cam")
    none = resolve_recipe("soft", lambda _: empty, [], [("--set", "data.test_cameras=null")])
    assert none.recipe.data.test_cameras is None


def test_the_keys_that_hold_names_are_those_of_the_recipe() -> None:
    models = {name: field.annotation for name, field in Recipe.model_fields.items()}
    lists = {
        (section, key)
        for section, model in models.items()
        for key, field in getattr(model, "model_fields", {}).items()
        if "tuple[str" in str(field.annotation)
    }
    assert lists == set(NAMES)
