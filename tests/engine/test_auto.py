"""What is measured of a scene, and what ``auto`` makes of it."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, final

import numpy as np
import pytest
from auto_parts import asking
from hypothesis import given, settings
from hypothesis import strategies as st

from gsstream.cli.main import run_command
from gsstream.core.auto import Choice, SceneFacts
from gsstream.core.cameras import Cameras
from gsstream.core.errors import ComponentError, InputError, OutputError, RecipeError
from gsstream.core.frame import Frame, PointCloud
from gsstream.engine.assembly.assemble import assemble
from gsstream.engine.assembly.pending import refuse_pending
from gsstream.engine.auto.colour_gain import colour_gain
from gsstream.engine.auto.facts import scene_facts
from gsstream.engine.auto.rules import recall, record, settle, sh_degree
from gsstream.plugins.catalog import load_catalog
from gsstream.recipe.load import load_recipe, resolve_recipe
from gsstream.recipe.save import save_resolved
from gsstream.structure.flat import Flat
from gsstream.testing.common.auto import extreme_scenes

FACTS = extreme_scenes()[0]


def rig(count: int, radius: float = 3.0, size: tuple[int, int] = (64, 48)) -> Cameras:
    """Cameras on an arc above the plane y = 0 that look at the origin."""
    views = []
    for angle in np.linspace(-1.0, 1.0, count):
        centre = radius * np.array([np.sin(angle), -0.4, -np.cos(angle)])
        forward = -centre / np.linalg.norm(centre)
        right = np.cross(forward, [0, -1.0, 0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        view = np.eye(4)
        view[:3, :3], view[:3, 3] = rotation, -rotation @ centre
        views.append(view)
    ks = np.repeat(np.array([[[50.0, 0, size[0] / 2], [0, 50.0, size[1] / 2], [0, 0, 1]]]), count, 0)
    return Cameras(tuple(f"c{i}" for i in range(count)), np.array(views), ks, *size)


def scene(cameras: Cameras, points: int = 300, seed: int = 0) -> tuple[PointCloud, Frame]:
    """Random seeds around the origin, and noise for images."""
    draw = np.random.default_rng(seed)
    xyz = draw.normal(0, 0.4, (points, 3)).astype(np.float32)
    images = draw.random((len(cameras), cameras.height, cameras.width, 3)).astype(np.float32)
    return PointCloud(xyz, np.full_like(xyz, 0.5), "test"), Frame(0, 0.0, images, cameras)


def finite(facts: SceneFacts) -> bool:
    numbers = [facts.span_pixels, facts.span_spacings, *facts.closeness, facts.texture, *facts.colour_gain]
    return bool(np.isfinite(numbers).all())


@settings(max_examples=15, deadline=None)
@given(scale=st.sampled_from([1e-3, 0.37, 1000.0]), seed=st.integers(0, 99))
def test_a_scaled_scene_has_the_same_facts(scale: float, seed: int) -> None:
    cameras = rig(7)
    cloud, frame = scene(cameras, seed=seed)
    views = cameras.viewmats.copy()
    views[:, :3, 3] *= scale
    larger = PointCloud((cloud.xyz * np.float32(scale)), cloud.rgb, "test")
    one = scene_facts(cloud, frame)
    other = scene_facts(larger, replace(frame, cameras=replace(cameras, viewmats=views)))
    for name in ("span_pixels", "span_spacings", "distance_ratio", "closeness", "texture", "colour_gain"):
        np.testing.assert_allclose(getattr(other, name), getattr(one, name), rtol=2e-3, atol=2e-3, err_msg=name)


@pytest.mark.parametrize("cameras", [rig(1), rig(2), rig(5, radius=1e-4), rig(30)], ids=["one", "two", "close", "many"])
@pytest.mark.parametrize("points", [1, 2, 300])
@pytest.mark.parametrize("images", ["noise", "black", "white"])
def test_facts_are_finite_at_the_extremes(cameras: Cameras, points: int, images: str) -> None:
    cloud, frame = scene(cameras, points)
    if images != "noise":
        frame = replace(frame, images=np.full_like(frame.images, float(images == "white")))
    facts = scene_facts(cloud, frame)
    assert finite(facts)
    assert facts.distance_ratio >= 1
    assert min(facts.closeness) >= 0
    if images != "noise":
        assert facts.texture == 0
        assert facts.colour_gain == (0.0, 0.0, 0.0)


def test_facts_of_coplanar_cameras_and_of_points_at_one_place() -> None:
    cameras = rig(6)
    flat = cameras.viewmats.copy()
    flat[:, :3, :3] = np.eye(3)
    flat[:, :3, 3] = np.stack([np.arange(6) * 0.1, np.zeros(6), np.ones(6)], 1)
    cloud, frame = scene(replace(cameras, viewmats=flat))
    assert finite(scene_facts(cloud, frame))
    same = PointCloud(np.zeros((50, 3), np.float32), np.zeros((50, 3), np.float32), "test")
    facts = scene_facts(same, frame)
    assert finite(facts)
    assert facts.span_pixels == 0
    assert facts.span_spacings == 1


def test_facts_need_seeds() -> None:
    cloud, frame = scene(rig(3))
    none = PointCloud(cloud.xyz[:0], cloud.rgb[:0], "none")
    with pytest.raises(InputError, match="got 0 seeds and 3 cameras"):
        scene_facts(none, frame)


def painted(cameras: Cameras, degree: int, strength: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """(images, seeds): one seed a pixel block apart, whose colour in each camera is a harmonic of that degree."""
    draw = np.random.default_rng(seed)
    xyz = draw.uniform(-0.8, 0.8, (400, 3))
    images = np.full((len(cameras), cameras.height, cameras.width, 3), 0.5)
    tilt = draw.normal(size=(400, 3))
    for view, (matrix, k) in enumerate(zip(cameras.viewmats, cameras.Ks, strict=True)):
        local = xyz @ matrix[:3, :3].T + matrix[:3, 3]
        column, row = (((local @ k.T)[:, :2] / local[:, 2:]) // 1).astype(int).T
        away = xyz - cameras.centers[view]
        away /= np.linalg.norm(away, axis=1, keepdims=True)
        mine = (local[:, 2] > 0) & (column >= 0) & (row >= 0) & (column < cameras.width) & (row < cameras.height)
        value = 0.5 + strength * (tilt * away).sum(1) ** degree + draw.normal(0, 0.01, 400)
        images[view, row[mine], column[mine]] = value[mine, None]
    return images.clip(0, 1), xyz


def test_colours_that_do_not_depend_on_the_view_gain_nothing() -> None:
    cameras = rig(20, size=(640, 480))
    cameras = replace(cameras, Ks=cameras.Ks * np.array([[[10, 1, 1], [1, 10, 1], [1, 1, 1]]]))
    images, xyz = painted(cameras, 1, 0.0)
    assert max(colour_gain(images, cameras, xyz)) < 0.1


def test_colours_that_depend_on_the_view_gain_and_more_so_when_they_depend_more() -> None:
    cameras = rig(20, size=(640, 480))
    cameras = replace(cameras, Ks=cameras.Ks * np.array([[[10, 1, 1], [1, 10, 1], [1, 1, 1]]]))
    weak, strong = (colour_gain(*_first(painted(cameras, 1, s), cameras))[0] for s in (0.02, 0.1))
    assert 0.3 < weak < strong


def _first(drawn: tuple[np.ndarray, np.ndarray], cameras: Cameras) -> tuple[np.ndarray, Cameras, np.ndarray]:
    return drawn[0], cameras, drawn[1]


@given(gains=st.tuples(*[st.floats(-9, 9)] * 3), more=st.floats(0, 5))
def test_the_degree_never_falls_when_the_highest_gains_more(gains: tuple[float, float, float], more: float) -> None:
    low = sh_degree(replace(FACTS, colour_gain=gains)).value
    high = sh_degree(replace(FACTS, colour_gain=(gains[0], gains[1], gains[2] + more))).value
    assert 0 <= low <= high <= 3
    assert sh_degree(replace(FACTS, colour_gain=tuple(-abs(g) for g in gains))).value == 0


@given(cameras=st.integers(1, 9), gain=st.floats(-9, 9))
def test_few_cameras_keep_the_usual_degree(cameras: int, gain: float) -> None:
    assert sh_degree(replace(FACTS, cameras=cameras, colour_gain=(gain, 0.0, 0.0))).value == 2


def _three(facts: SceneFacts, config: Any) -> Choice:
    return Choice(facts.cameras, "as many as there are cameras")


def _same_again(facts: SceneFacts, config: Any) -> Choice:
    return Choice(config.first + 1, f"one more than {config.first}")


def _bad(facts: SceneFacts, config: Any) -> Choice:
    return Choice("plenty", "no reason")


@final
class Asking(Flat):  # type: ignore[misc]  # a test may inherit
    """Flat with settings of its own (ours)."""

    class Config(Flat.Config):
        first: int = 1
        second: int = 1
        third: int = 1

    auto_rules = MappingProxyType({"first": _three, "second": _same_again, "third": _bad})


def test_later_rules_see_what_earlier_ones_chose() -> None:
    done = settle(asking(Asking, first="auto", second="auto", third=7), lambda: FACTS, {})
    assert done.structure.config == Asking.Config(first=12, second=13, third=7)
    assert done.recipe.structure.params == {"first": 12, "second": 13, "third": 7}
    assert done.pending == ()
    assert list(done.chosen) == ["structure.params.first", "structure.params.second"]
    assert done.resolved.origin(("structure", "params", "first")).label == "auto: as many as there are cameras"
    fixed = settle(asking(Asking, first=5, second="auto"), lambda: FACTS, {})
    assert fixed.structure.config.second == 6


def test_known_choices_are_taken_and_nothing_is_measured() -> None:
    def never() -> SceneFacts:
        raise AssertionError("measured")

    known = {"structure.params.first": Choice(3, "said so")}
    assert settle(asking(Asking, first="auto"), never, known).structure.config.first == 3


def test_what_was_chosen_comes_back_from_a_stream() -> None:
    done = settle(asking(Asking, first="auto", second="auto"), lambda: FACTS, {})
    again = recall(asking(Asking, first="auto", second="auto"), record(done))
    assert again.structure == done.structure
    assert again.recipe == done.recipe
    assert again.chosen == done.chosen
    written_out = recall(asking(Asking, first=12, second=13), record(done))
    assert written_out.chosen == done.chosen
    with pytest.raises(OutputError, match=r"'auto' for structure.params.second, but .* --overwrite"):
        recall(asking(Asking, second="auto"), {"auto": {}})


def test_a_rule_that_chooses_what_its_part_refuses_is_the_parts_fault() -> None:
    with pytest.raises(ComponentError, match=r"'Asking' .* rule for third chose 'plenty'"):
        settle(asking(Asking, third="auto"), lambda: FACTS, {})


def test_only_a_run_chooses() -> None:
    with pytest.raises(RecipeError, match=r"structure.params.first: 'auto' is chosen by 'gsstream run'"):
        refuse_pending(asking(Asking, first="auto"))


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("structure.padding=auto", "'auto' is offered for root_exponent"),
        ("gate.temperature=auto", "it offers no 'auto'"),
        ("stream.epochs=auto", "stream.epochs: input should be a valid integer"),
        ("first_frame.sh_degree=4", "expected an integer from 0 to 3, or 'auto', got 4"),
        ("first_frame.sh_degree=true", "expected an integer from 0 to 3, or 'auto', got True"),
        ("first_frame.sh_degree=automatic", "expected an integer from 0 to 3, or 'auto', got 'automatic'"),
    ],
)
def test_auto_where_nobody_offers_it(setting: str, message: str) -> None:
    catalog = load_catalog()
    with pytest.raises(RecipeError, match=message):
        assemble(resolve_recipe("s2gs-edge", catalog.recipe_path, (), [("--set", setting)]), catalog)


def test_a_stepper_that_reads_no_structure_refuses_its_auto() -> None:
    catalog = load_catalog()
    sets = [("--set", "structure=octree"), ("--set", "structure.root_exponent=auto")]
    with pytest.raises(RecipeError, match=r"root_exponent: the stepper 'hold' does not read it"):
        assemble(resolve_recipe("hold", catalog.recipe_path, (), sets), catalog)


def test_auto_survives_the_saved_recipe(tmp_path: Path) -> None:
    catalog = load_catalog()
    keys = ("first_frame.sh_degree", "structure.root_exponent")
    sets = [("--set", f"{key}=auto") for key in keys]
    parts = assemble(resolve_recipe("s2gs-edge", catalog.recipe_path, (), sets), catalog)
    assert [".".join(path) for path in parts.pending] == ["first_frame.sh_degree", "structure.params.root_exponent"]
    save_resolved(tmp_path / "asked.yaml", parts.resolved)
    assert assemble(load_recipe(tmp_path / "asked.yaml"), catalog).pending == parts.pending
    done = settle(parts, lambda: FACTS, {})
    save_resolved(tmp_path / "chosen.yaml", done.resolved)
    again = assemble(load_recipe(tmp_path / "chosen.yaml"), catalog)
    assert again.pending == ()
    assert again.recipe == done.recipe
    assert "# auto: " in (tmp_path / "chosen.yaml").read_text()


def test_the_schema_for_editors_takes_auto_where_it_is_offered(tmp_path: Path) -> None:
    jsonschema = pytest.importorskip("jsonschema", reason="jsonschema is not installed")
    assert run_command(["recipe", "schema", "s2gs-edge", "--out", str(tmp_path / "s.json")]) == 0
    schema = jsonschema.Draft202012Validator(json.loads((tmp_path / "s.json").read_text()))
    good = {"structure": {"params": {"root_exponent": "auto"}}, "first_frame": {"sh_degree": "auto"}}
    assert not list(schema.iter_errors(good))
    for bad in ({"structure": {"params": {"padding": "auto"}}}, {"structure": {"params": {"root_exponent": "much"}}}):
        assert list(schema.iter_errors(bad))
