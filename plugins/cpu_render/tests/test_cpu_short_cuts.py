"""The compiled renderer renders, compares and differentiates in one call, unless every call of a part is checked."""

from __future__ import annotations

from collections import Counter
from typing import Any

import pytest
from gsstream_cpu_render import _native, native

from gsstream.discovery.catalog import load_catalog
from gsstream.engine.assembly.assemble import assemble
from gsstream.engine.frame0.points import gather_points
from gsstream.engine.run.encoder import Encoder
from gsstream.input.recordings.open import open_source
from gsstream.recipe.load import resolve_recipe

SOURCE = "synthetic:frames=3&views=3&width=64&height=48&supersample=1"
SETTINGS = (
    "first_frame.max_iterations=30",
    "first_frame.points=recording",
    "first_frame.max_points=400",
    "stream.epochs=2",
    "stream.change_threshold=12",
)


@pytest.mark.parametrize("method", ["s2gs-edge", "s2gs-paper"])
@pytest.mark.parametrize(("level", "short"), [("step", False), ("frame", True), ("off", True)])
def test_every_frame_takes_the_short_cut_unless_each_step_is_checked(
    method: str, level: str, short: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls: Counter[int] = Counter()

    def counted(*arguments: Any) -> Any:
        calls[index] += 1
        return _native.Comparison(*arguments)

    class Counting:
        """The compiled module; only what renders, compares and differentiates in one call takes a comparison, so these
        are counted.
        """

        Comparison = staticmethod(counted)

        def __getattr__(self, name: str) -> Any:
            return getattr(_native, name)

    monkeypatch.setattr(native, "_native", Counting())
    catalog = load_catalog()
    resolved = resolve_recipe(method, catalog.recipe_path, (), [("the test", text) for text in SETTINGS])
    parts, source = assemble(resolved, catalog, level), open_source(SOURCE)
    encoder = Encoder(parts, source.info, lambda frame: gather_points(source, frame, parts.recipe.first_frame))
    for index in range(3):
        encoder.encode(source.frame(index))
    assert set(calls) == ({0, 1, 2} if short else set())
