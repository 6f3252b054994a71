"""Which settings frame 0 depends on: what shares a frame 0 between runs, or keeps one, goes by them."""

from __future__ import annotations

from pathlib import Path

import pytest
from flow_runs import encode

from gsstream.packet import StreamReader, decode_packet
from gsstream.recipe.load import load_recipe
from gsstream.recipe.model import Codec, first_frame_settings

OTHER = {"key_interval": 3, "trim": 0.3, "key_rd_lambda": 0.0, "first_layer": 1.0}


def packet(out: Path) -> bytes:
    with StreamReader(out / "stream.gss") as reader:
        return reader.read(reader.frames[0])


@pytest.fixture(scope="module")
def usual(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("usual")
    encode(out, "--frames", "1")
    return out


def test_every_setting_of_the_codec_is_asked_for() -> None:
    assert set(OTHER) == set(Codec.model_fields)


@pytest.mark.parametrize("key", OTHER)
def test_the_codec_changes_frame_0_where_the_settings_of_frame_0_say_so(key: str, usual: Path, tmp_path: Path) -> None:
    """The description of the run, which names the recipe, differs in any case; all else of the packet is compared."""
    encode(tmp_path, "--frames", "1", **{f"codec__{key}": OTHER[key]})
    recipes = [load_recipe(out / "recipe.yaml").recipe for out in (usual, tmp_path)]
    ours, theirs = (first_frame_settings(recipe) for recipe in recipes)
    scenes = [decode_packet(None, packet(out)) for out in (usual, tmp_path)]
    same = all(
        a.tobytes() == b.tobytes()
        for (_, a), (_, b) in zip(scenes[0].gaussians.items(), scenes[1].gaussians.items(), strict=True)
    )
    same = same and abs(len(packet(usual)) - len(packet(tmp_path))) < 16
    assert same == (ours == theirs)
