"""Splits: what the options say happens, exactly and repeatably, and nothing else."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gsstream.core.errors import RecipeError, SourceError
from gsstream.discovery.catalog import load_catalog
from gsstream.engine.run.recording import reopen_recording
from gsstream.input.recordings.open import open_source
from gsstream.input.recordings.options import DataOptions
from gsstream.input.recordings.synthetic import SyntheticSource
from gsstream.input.recordings.transformed import transformed
from gsstream.recipe.load import resolve_recipe

WORLD = "synthetic:frames=12&views=4&width=16&height=12&supersample=1&motion=3"


def opened(uri: str = WORLD, **options: Any):
    return transformed(open_source(uri), DataOptions(**options))


def test_defaults_are_the_source_itself() -> None:
    source = open_source(WORLD)
    assert transformed(source, DataOptions()) is source


def test_a_test_camera_leaves_training_and_takes_its_points_along() -> None:
    plain = open_source(WORLD)
    a, b, *rest = plain.info.train.ids
    source = opened(test_cameras=(b, a))
    assert source.info.test.ids == (b, a)
    assert source.info.train.ids == (*rest, *plain.info.test.ids)
    np.testing.assert_array_equal(source.frame(2, "test").images, plain.frame(2).images[[1, 0]])
    np.testing.assert_array_equal(source.frame(2).images[-1], plain.frame(2, "test").images[0])
    np.testing.assert_array_equal(source.info.test.viewmats, plain.info.train.viewmats[[1, 0]])
    assert len(source.points()) == len(plain.points()) * len(rest) / len(plain.info.train), "those of a and b are out"
    assert opened("demo", test_cameras=("cam01",)).points() is None, "which camera took part is not known"
    assert len(opened(test_cameras=(b,), leak="points").points()) == len(plain.points())
    assert opened(test_cameras=()).points() is not None


def test_leak_into_training_is_asked_for_and_complete() -> None:
    plain, source = open_source(WORLD), opened(leak="training")
    assert source.info.train.ids == (*plain.info.train.ids, *plain.info.test.ids)
    assert source.info.test.ids == plain.info.test.ids
    np.testing.assert_array_equal(source.frame(1).images[-1], plain.frame(1, "test").images[0])


@settings(max_examples=40, deadline=None)
@given(views=st.integers(2, 30))
def test_the_tuning_split_shows_nothing_of_the_test_cameras(views: int) -> None:
    """Whatever the rig: the test cameras are nowhere, the new ones were training cameras, about one in six of them."""
    plain = open_source(WORLD.replace("views=4", f"views={views}"))
    info = opened(WORLD.replace("views=4", f"views={views}"), split="tuning").info
    assert sorted((*info.train.ids, *info.test.ids)) == sorted(plain.info.train.ids), "no camera is lost, none doubled"
    assert len(info.test) >= 1
    assert abs(len(info.test) - views / 6) <= 0.5 or len(info.test) == 1
    again = opened(WORLD.replace("views=4", f"views={views}"), split="tuning").info
    assert again.test.ids == info.test.ids, "the choice knows no seed"


def test_cameras_of_the_tuning_split_are_where_the_other_cameras_are_nearest() -> None:
    """Against all subsets: the medoids have the least sum of distances, or nearly (a search by swaps may miss it)."""
    plain = open_source(WORLD.replace("views=4", "views=13"))
    chosen = opened(WORLD.replace("views=4", "views=13"), split="tuning").info.test.ids
    centers = plain.info.train.centers.astype(np.float64)
    apart = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    costs = {pair: apart[:, pair].min(1).sum() for pair in itertools.combinations(range(13), len(chosen))}
    mine = tuple(plain.info.train.ids.index(name) for name in chosen)
    assert len(chosen) == 2
    assert costs[mine] <= 1.05 * min(costs.values())
    assert costs[mine] < np.median(list(costs.values()))


def test_points_that_a_test_camera_of_the_tuning_split_has_seen_are_withheld() -> None:
    assert opened("demo", split="tuning").points() is None, "nobody knows which camera took part in which of them"
    plain, source = open_source(WORLD), opened(split="tuning")
    kept = [i for i, name in enumerate(plain.info.train.ids) if name in source.info.train.ids]
    cloud = source.points()
    assert len(cloud) == len(plain.points()) * len(kept) / len(plain.info.train)
    np.testing.assert_array_equal(cloud.rgb, plain.frame(0).images[kept][:, 1::3, 1::3].reshape(-1, 3))


def test_points_of_test_cameras_that_were_taken_away_are_withheld_too() -> None:
    """A COLMAP model's points may be of any camera: those of either kind of test camera go."""
    asked: list[set[str]] = []

    class Attributed(SyntheticSource):
        def points_without(self, cameras: Any, kind: Any = "recording") -> Any:
            asked.append(set(cameras))
            return super().points_without(cameras, kind)

    source = transformed(Attributed.from_query(WORLD.partition(":")[2]), DataOptions(split="tuning"))
    source.points()
    assert asked == [{*source.info.test.ids, "test"}]


@given(st.integers(2, 7))
@settings(max_examples=12, deadline=None)
def test_fewer_views_are_subsets_of_more(count: int) -> None:
    def chosen(n: int) -> tuple[str, ...]:
        return opened(WORLD.replace("views=4", "views=8"), train_views=n).info.train.ids

    ids = open_source(WORLD.replace("views=4", "views=8")).info.train.ids
    assert len(chosen(count)) == count
    assert set(chosen(count)) < set(chosen(count + 1))
    assert list(chosen(count)) == sorted(chosen(count), key=ids.index)


FAULTS: dict[str, tuple[dict[str, Any], str]] = {
    "ghost test": ({"test_cameras": ("cam9",)}, "data.test_cameras: no camera 'cam9'; cameras: cam"),
    "ghost train": ({"train_cameras": ("cam9",)}, "data.train_cameras: no camera 'cam9'"),
    "both sides": ({"train_cameras": ("TEST",)}, "would train and test"),
    "twice": ({"test_cameras": ("TEST", "TEST")}, "given twice"),
    "tuning leak": ({"split": "tuning", "leak": "points"}, "takes the test cameras away, got data.leak=points"),
    "tuning alone": ({"split": "tuning", "train_cameras": ("cam00",)}, "needs two training cameras"),
    "nobody": ({"train_cameras": ()}, "no training camera is left"),
    "too many": ({"train_views": 9}, "there are only 4 training cameras, got 9"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_faulty_options_are_explained(fault: str) -> None:
    options, message = FAULTS[fault]
    test = open_source(WORLD).info.test.ids[0]
    named = {
        key: tuple(v.replace("TEST", test) for v in value) if isinstance(value, tuple) else value
        for key, value in options.items()
    }
    with pytest.raises(SourceError, match=message):
        opened(**named)


def test_options_are_recipe_keys_with_provenance_and_travel_with_the_stream() -> None:
    catalog = load_catalog()
    overrides = [("--set", "data.train_views=3"), ("--set", 'data.test_cameras=["cam_0"]')]
    resolved = resolve_recipe("dense", catalog.recipe_path, (), overrides)
    assert resolved.recipe.data == DataOptions(train_views=3, test_cameras=("cam_0",))
    assert resolved.origin(("data", "train_views")).label == "command line"
    with pytest.raises(RecipeError, match=r"data\.train_view'.*did you mean 'train_views'"):
        resolve_recipe("dense", catalog.recipe_path, (), [("--set", "data.train_view=3")])
    recipe = resolve_recipe("dense", catalog.recipe_path, (), [("--set", "data.train_views=2")])
    again = reopen_recording(WORLD, recipe.recipe.model_dump(mode="json"), catalog)
    assert again.frame(0).images.tobytes() == opened(train_views=2).frame(0).images.tobytes()
    with pytest.raises(RecipeError, match=r"data\.fog.*of another version of gsstream"):
        reopen_recording(WORLD, {"data": {"fog": 1}}, catalog)
