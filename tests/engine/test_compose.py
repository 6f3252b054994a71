"""A method that is composed in Python is the method of the same names; how many calls lie below a command."""

from __future__ import annotations

import re
import sys
from pathlib import Path
from typing import Any

import pytest

from gsstream.cli.main import run_command
from gsstream.core.errors import InputError
from gsstream.core.kinds import METHOD_SLOTS
from gsstream.discovery.catalog import load_catalog
from gsstream.encode import Encoder, encoder_for, encoder_for_rig, open_recording
from gsstream.engine.assembly.assemble import with_live
from gsstream.engine.run.parts_method import PartsMethod
from gsstream.method.static import Hold
from gsstream.parts.motion.none import Still
from gsstream.parts.motion.rigid import Rigid
from gsstream.recipe.load import ResolvedRecipe
from gsstream.recipe.model import Recipe
from gsstream.recipe.save import to_yaml

WORLD = "synthetic:frames=3&views=3&width=32&height=24&supersample=1"
TINY: dict[str, Any] = {
    "first_frame.max_iterations": 8,
    "first_frame.max_points": 200,
    "first_frame.points": "recording",
    "first_frame.prune_error": 0,
    "stream.epochs": 1,
}


def encoder(settings: dict[str, Any], method: str = "dense", **parts: Any) -> Encoder:
    with open_recording(WORLD) as source:
        return encoder_for(method, source, {**TINY, **settings}, **parts)


def packets(made: Encoder) -> list[bytes]:
    with open_recording(WORLD) as source:
        return [made.encode(source.frame(index)).packet.data for index in range(3)]


def test_live_parts_make_the_bytes_of_the_same_parts_by_name() -> None:
    """The key packet holds the recipe: a stream of composed parts is resumed by a recipe file, too."""
    named = encoder({"motion": "rigid", "motion.epochs": 3, "confidence": "view-gradient"})
    live = encoder({}, motion=Rigid(Rigid.Config(epochs=3)), confidence="view-gradient")
    assert live.assembly.recipe == named.assembly.recipe
    assert packets(live) == packets(named)


def test_what_is_not_given_is_the_recipe_of_the_method() -> None:
    own, given = encoder({}, "s2gs-edge"), encoder({}, "s2gs-edge", motion=Still())
    for slot in METHOD_SLOTS:
        assert (getattr(own.assembly, slot) == getattr(given.assembly, slot)) == (slot != "motion"), slot
    assert given.assembly.title.startswith("s2gs-edge + motion=still")
    with open_recording(WORLD) as source:
        rig = encoder_for_rig("s2gs-edge", source.info.train, settings=TINY, motion=Still())
    assert rig.assembly.part("motion") == Still()


@pytest.mark.parametrize(
    ("settings", "parts", "message"),
    [
        ({}, {"motion": Hold()}, "motion: expected a live MotionPart or the name of one, got Hold"),
        ({}, {"motoin": Rigid()}, "no slot is called motoin: expected some of structure, confidence"),
        ({"motion.epochs": 3}, {"motion": Rigid()}, "motion.epochs: the part is given live"),
    ],
)
def test_what_does_not_fit_is_refused(settings: dict[str, Any], parts: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError) as caught:
        encoder(settings, **parts)
    assert str(caught.value).startswith(message)


def test_every_part_that_is_installed_is_called_in_the_recipe_as_in_the_catalogue() -> None:
    catalog, parts = load_catalog(), 0
    for slot in METHOD_SLOTS:
        for name in catalog.names(slot):
            if name == "onnx":
                continue  # is made with a file alone
            part = catalog.resolve(slot, name)()
            found = with_live(ResolvedRecipe(Recipe(), {}), {slot: part}, catalog)
            assert getattr(found.recipe, slot).name == name
            parts += 1
    assert parts > 20


def test_a_part_that_no_plugin_declares_is_called_by_its_class() -> None:
    motion = type("Mine", (Rigid,), {"__module__": "studio"})()
    made = encoder({}, motion=motion)
    assert made.assembly.recipe.motion.name == "studio:Mine"
    assert re.search(r"studio:Mine\"? +# Python$", to_yaml(made.assembly.resolved), re.MULTILINE)
    assert packets(made)[1] == packets(encoder({}, motion="rigid"))[1]


@pytest.mark.parametrize("settings", [(), ("--set", "stream.on_error=repeat", "--budget", "size=50KB")])
def test_a_method_is_at_most_six_calls_below_the_command(
    settings: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[list[str]] = []
    step = PartsMethod.step

    def watched(*arguments: object) -> object:
        frame, names = sys._getframe(1), []
        while frame is not None:
            names.append(f"{frame.f_globals['__name__']}.{frame.f_code.co_name}")
            frame = frame.f_back
        seen.append(names)
        return step(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(PartsMethod, "step", watched)
    command = ["run", "--source", "synthetic:frames=2&views=3&width=32&height=24&supersample=1", "--method", "dense"]
    tiny = ["--set", "first_frame.max_iterations=4", "--quiet", "--no-pictures", "--no-video", "--out", str(tmp_path)]
    assert run_command([*command, *tiny, *settings]) == 0
    (names,) = seen
    depth = names.index("gsstream.cli.run.run")
    assert depth < 6, names[: depth + 1]
