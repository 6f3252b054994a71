"""Choices tried out in short frames 0: where a search goes, what it is judged by, and that it ends."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any, final

import numpy as np
import pytest
from auto_parts import asking
from hypothesis import given
from hypothesis import strategies as st

from gsstream.core.auto import Choice
from gsstream.engine.assembly.assemble import Assembly, assemble
from gsstream.engine.auto.climb import MARGIN, try_out
from gsstream.engine.auto.rules import settle
from gsstream.engine.auto.short_fits import Trial
from gsstream.engine.auto.trials import usual_values
from gsstream.plugins.catalog import load_catalog
from gsstream.recipe.load import resolve_recipe
from gsstream.structure.flat import Flat
from gsstream.testing.common.auto import extreme_scenes

FACTS = extreme_scenes()[0]
LADDER = tuple(range(10))
#: The usual values, where they are those of the rules.
RULES = {"structure.params.wide": 5, "structure.params.deep": 2}


@final
class Asking(Flat):  # type: ignore[misc]  # a test may inherit
    """Flat with two settings that a search can move, and one that no trial can judge (ours)."""

    class Config(Flat.Config):
        wide: int = 0
        deep: int = 0
        late: int = 0

    auto_rules = MappingProxyType({
        "wide": lambda facts, config: Choice(5, "the middle", LADDER),
        "deep": lambda facts, config: Choice(2, "near the end", LADDER),
        "late": lambda facts, config: Choice(7, "only time will tell"),
    })  # fmt: skip


def settled(trials: int = 100) -> Assembly:
    """All three chosen by their rules."""
    parts = asking(Asking, **dict.fromkeys(Asking.auto_rules, "auto"))
    first = parts.recipe.first_frame.model_copy(update={"trials": trials})
    return settle(replace(parts, recipe=parts.recipe.model_copy(update={"first_frame": first})), lambda: FACTS, {})


class Hill:
    """A trial with one best place, equal scenes on every second step of ``wide``, and nothing else to find."""

    def __init__(self, wide: int, deep: int, size: int = 1000, flat: bool = False) -> None:
        self.top, self.size, self.flat = (wide, deep), size, flat
        self.asked: list[tuple[int, int, int]] = []
        self.known: dict[tuple[int, int], Trial] = {}

    def __call__(self, parts: Assembly, best: Trial | None) -> Trial:
        config = parts.structure.config
        self.asked.append((config.wide, config.deep, config.late))
        wide = config.wide // 2 * 2 if self.flat else config.wide
        distance = abs(wide - self.top[0]) + abs(config.deep - self.top[1])
        return self.known.setdefault((wide, config.deep), Trial((30.0 - distance,), 1000, self.size))


places = st.sampled_from(LADDER)


@given(wide=places, deep=places)
def test_a_search_climbs_to_the_top_and_says_where_it_was(wide: int, deep: int) -> None:
    hill, said = Hill(wide, deep), []
    done = try_out(settled(), RULES, hill, said.append)
    assert (done.structure.config.wide, done.structure.config.deep) == (wide, deep)
    assert done.recipe.structure.params == {"wide": wide, "deep": deep, "late": 7}
    assert len(said) == len(hill.known)
    why = done.chosen["structure.params.wide"].why
    assert why.startswith(f"best of {len(said)} trials (30.00 dB on left-out cameras, by rules ")
    assert why.endswith("by rule 5: the middle")
    assert done.chosen["structure.params.late"] == Choice(7, "only time will tell")
    assert {late for _, _, late in hill.asked} == {7}


@given(wide=st.sampled_from(LADDER[::2]), deep=places)
def test_settings_that_start_alike_do_not_end_a_walk(wide: int, deep: int) -> None:
    hill = Hill(wide, deep, flat=True)
    done = try_out(settled(), RULES, hill, lambda _: None)
    assert done.structure.config.wide // 2 * 2 == wide
    assert done.structure.config.deep == deep


@given(wide=places, deep=places, most=st.integers(1, 12))
def test_a_search_makes_no_more_trials_than_it_may_and_never_ends_below_the_rules(
    wide: int, deep: int, most: int
) -> None:
    hill = Hill(wide, deep)
    done = try_out(settled(most), RULES, hill, lambda _: None)
    assert len(hill.known) <= most
    end = done.structure.config
    assert hill.known[end.wide, end.deep].psnr >= hill.known[5, 2].psnr


@given(wide=places, deep=places)
def test_a_search_starts_where_it_is_better(wide: int, deep: int) -> None:
    usual = {"structure.params.wide": wide, "structure.params.deep": deep}
    hill, said = Hill(wide, deep), []
    done = try_out(settled(2), usual, hill, said.append)
    assert (done.structure.config.wide, done.structure.config.deep) == (wide, deep)
    if (wide, deep) != (5, 2):
        assert said[1].startswith("auto: trial 2, the usual values: 30.00 dB")
    worse = {"structure.params.wide": 9 - wide, "structure.params.deep": 9 - deep}
    assert try_out(settled(1), worse, Hill(5, 2), lambda _: None).structure.config.wide == 5
    off = {"structure.params.wide": 77, "structure.params.deep": deep}
    assert try_out(settled(2), off, Hill(5, deep), lambda _: None).structure.config == Asking.Config(
        wide=5, deep=deep, late=7
    )


def test_usual_values_are_the_defaults() -> None:
    catalog = load_catalog()
    keys = ("first_frame.sh_degree", "structure.log_base", "update.sh0.latent")
    recipe = resolve_recipe("s2gs-edge", catalog.recipe_path, (), [("--set", f"{key}=auto") for key in keys])
    fixed = assemble(resolve_recipe("s2gs-edge", catalog.recipe_path), catalog).recipe
    assert usual_values(assemble(recipe, catalog)) == {
        "first_frame.sh_degree": fixed.first_frame.sh_degree,
        "structure.params.log_base": fixed.structure.params["log_base"],
        "update.params.sh0.latent": fixed.update.params["sh0"]["latent"],
    }


def test_no_trials_are_no_search() -> None:
    def never(parts: Assembly, best: Trial | None) -> Trial:
        raise AssertionError("tried")

    parts = settled(0)
    assert try_out(parts, RULES, never, lambda _: None) is parts


def test_equal_quality_goes_to_the_smaller_packet_and_little_quality_does_not_buy_a_large_one() -> None:
    def trial(parts: Assembly, best: Trial | None) -> Trial:
        wide = parts.structure.config.wide
        return Trial((30.0 + 0.01 * wide,), 1, 1000 * 2**wide)

    assert try_out(settled(), RULES, trial, lambda _: None).structure.config.wide == 0


@final
class Picky(Flat):  # type: ignore[misc]  # a test may inherit
    """Refuses a value that its rule would try: the search looks behind it (ours)."""

    class Config(Asking.Config):
        def model_post_init(self, _: Any) -> None:
            if self.wide == 6:
                raise ValueError("not six")

    auto_rules = Asking.auto_rules


def test_a_search_steps_over_what_the_part_refuses() -> None:
    parts = settled()
    parts = replace(parts, structure=Picky(Picky.Config(**parts.structure.config.model_dump())))
    assert try_out(parts, RULES, Hill(8, 2), lambda _: None).structure.config.wide == 8


def test_a_choice_off_its_own_ladder_is_refused() -> None:
    with pytest.raises(ValueError, match=r"got 3, which is not in \(1, 2\)"):
        Choice(3, "why not", (1, 2))


def by_wide(values: Mapping[int, tuple[float, ...]]) -> Any:
    """Trials by ``wide`` alone; where nothing is given, hopeless."""
    trials = {wide: Trial(folds, 1, 1000) for wide, folds in values.items()}
    hopeless = Trial((0.0,) * len(values[5]), 1, 1000)
    return lambda parts, best: trials.get(parts.structure.config.wide, hopeless)


def chosen(values: Mapping[int, tuple[float, ...]]) -> int:
    done: int = try_out(settled(), RULES, by_wide(values), lambda _: None).structure.config.wide
    return done


@pytest.mark.parametrize("wide", [4, 6])
def test_one_fold_misleads_and_two_do_not(wide: int) -> None:
    """Two ways that tie on the cameras of the first fold: the second fold tells them apart."""
    first = {5: (30.0,), wide: (30.1,)}
    assert chosen(first) == wide
    assert chosen({5: (*first[5], 30.0), wide: (*first[wide], 29.6)}) == 5
    assert chosen({5: (*first[5], 29.6), wide: (*first[wide], 30.0)}) == wide


@given(wide=st.lists(st.floats(20, 30), min_size=2, max_size=4), most=st.integers(1, 4))
def test_the_mean_of_the_folds_decides(wide: list[float], most: int) -> None:
    values = {5: (25.0,) * len(wide[:most]), 6: tuple(wide[:most])}
    assert chosen(values) == (6 if float(np.mean(values[6])) > 25.0 + MARGIN else 5)


def test_a_trial_that_was_given_up_is_never_chosen() -> None:
    """Its one fold may be better than that fold of a best that only the other folds made the best."""
    assert chosen({5: (30.0, 31.0), 6: (30.9,)}) == 5
    said: list[str] = []
    try_out(settled(), RULES, by_wide({5: (30.0, 31.0), 6: (30.9,)}), said.append)
    assert [line.endswith("KB (given up, 1 of 2 folds)") for line in said] == ["wide = 6" in line for line in said]
    assert chosen({5: (30.0, 31.0), 6: (30.9, 30.9)}) == 6
