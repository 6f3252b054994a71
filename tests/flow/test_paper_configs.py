"""Every experiment of the paper is a recipe that can be assembled; the cheap ones run two frames."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import pytest
from flow_runs import metrics

from gsstream.cli.main import run_command
from gsstream.engine.assembly.assemble import Assembly, assemble
from gsstream.plugins.catalog import Catalog, load_catalog
from gsstream.recipe.load import recipe_hash, resolve_recipe

FOLDER = Path(__file__).parents[2] / "configs" / "paper"
FILES = sorted(path.relative_to(FOLDER).as_posix() for path in FOLDER.rglob("*.yaml"))
#: Other names for the same experiment, in another table.
SAME = {
    "components/5-hfp.yaml", "structure-sparsity/both.yaml", "structure-sparsity/neither.yaml",
    "structure-sparsity/sparsity.yaml", "confidence/robust.yaml", "root-resolution/2-to-8.yaml", "log-base/1.5.yaml",
    "octree-parts/neither.yaml", "octree-parts/both.yaml",
}  # fmt: skip
#: Lies on others; alone it is the dense baseline with an active set.
OVERLAY = "candidates.yaml"
TINY = [
    "first_frame.epochs=2", "first_frame.max_iterations=20", "first_frame.fill_points=100",
    "first_frame.max_points=600", "stream.epochs=1", "frames=2",
]  # fmt: skip
CHEAP = [
    "components/1-dense.yaml", "components/2-ste.yaml", "components/4-octree.yaml", "structure-sparsity/structure.yaml",
    "propagation/ft-0.80.yaml", "discretisation/binary-released.yaml", "confidence/uniform-random.yaml",
    "confidence/constant-zero.yaml", "confidence/released-ratio.yaml", "illumination/0.5.yaml",
    "first-frame/noise-30.yaml", "extensions/noise-normalised.yaml", "extensions/error-aware.yaml",
    "extensions/selective-leaf.yaml", "extensions/insertion.yaml",
]  # fmt: skip


@pytest.fixture(scope="module")
def catalog() -> Catalog:
    return load_catalog()


def assembled(catalog: Catalog, name: str, *more: Path) -> Assembly:
    return assemble(resolve_recipe(None, catalog.recipe_path, [FOLDER / name, *more]), catalog)


@pytest.mark.parametrize("name", FILES)
def test_every_file_is_assembled(catalog: Catalog, name: str) -> None:
    recipe = assembled(catalog, name).recipe
    if name == OVERLAY:
        return
    assert recipe.method == "s2gs"
    assert recipe.stream.epochs == 20, "the paper's tables share one budget"
    assert recipe.stream.change_threshold == 0.0, "the paper's tables know no active set"


def test_every_file_is_another_experiment(catalog: Catalog) -> None:
    hashes: dict[str, str] = {}
    for name in FILES:
        if name not in SAME:
            twin = hashes.setdefault(recipe_hash(assembled(catalog, name).recipe), name)
            assert twin == name, f"{name} and {twin} are the same run"
    assert set(FILES) >= SAME


def test_the_components_build_on_each_other(catalog: Catalog) -> None:
    """Each row of the component table differs from the one before in what the row says, and the last is the method."""
    names = ["1-dense", "2-ste", "3-regulariser", "4-octree", "5-hfp"]
    rows = [assembled(catalog, f"components/{name}.yaml").recipe.model_dump() for name in names]
    changed = [{key for key in a if a[key] != b[key]} for a, b in pairwise(rows)]
    assert changed[0] == {"confidence", "gate"}
    assert changed[1] == {"regularizer"}
    assert changed[2] == {"structure", "stream"}  # the stream: progressive training goes by octree level
    assert changed[3] == {"structure", "propagation"}
    # The paper has no bits in its loss and trims no packet; the shipped recipe does.
    ours = ("stream.rate_weight=0", "codec.trim=0", "update.means.step=0.02", "update.sh0.decoder_std=0.01")
    no_rate = [("--set", value) for value in ours]
    shipped = assemble(resolve_recipe("s2gs", catalog.recipe_path, [], no_rate), catalog).recipe
    assert recipe_hash(assembled(catalog, "components/5-hfp.yaml", FOLDER / OVERLAY).recipe) == recipe_hash(shipped)


@pytest.mark.parametrize("name", CHEAP)
def test_two_frames_of_the_demo(name: str, tmp_path: Path) -> None:
    sets = [item for value in TINY for item in ("--set", value)]
    command = [
        "run",
        "--source",
        "demo",
        "--recipe",
        str(FOLDER / name),
        "--out",
        str(tmp_path),
        "--quiet",
        "--no-video",
    ]
    assert run_command([*command, "--scale", "0.5", *sets]) == 0
    later = metrics(tmp_path)[1]
    assert later["frame"] == 1
    if name == "confidence/constant-zero.yaml":
        assert later["active_gates"] == 0
    if name in ("components/1-dense.yaml", "structure-sparsity/structure.yaml"):
        assert later["iterations"] == 8
