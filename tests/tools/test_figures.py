"""Figures of the results pages: drawn from the data, stale where the data change, readable as pictures."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from xml.etree import ElementTree

import pytest

from tools.figures import IMAGES, NAMED, curves_of, main, pictures, points_of, stale, write
from tools.results import PAGES, read_rows

NAMES = tuple(pictures())


def test_the_figures_show_the_numbers_of_the_data() -> None:
    assert stale() == []
    assert main(["--check"]) == 0


@pytest.fixture
def copied(tmp_path: Path) -> Path:
    """The data of two plans, and their figures beside them."""
    (tmp_path / "data").mkdir()
    shutil.copy(PAGES / "data" / "protocol.jsonl", tmp_path / "data")
    for name in NAMES:
        shutil.copy(IMAGES / name, tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("key", "becomes"),
    [
        ("kb", {"quality-bytes.svg"}),
        ("cpu_seconds", {"quality-seconds.svg"}),
        ("psnr_changed", {"quality-bytes.svg", "quality-seconds.svg"}),
        ("ssim", set()),
        ("curve_psnr", {"quality-time.svg"}),
    ],
)
def test_a_number_that_is_shown_makes_its_figure_stale(copied: Path, key: str, becomes: set[str]) -> None:
    path = copied / "data" / "protocol.jsonl"
    rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    changed = next(row for row in rows if row["kb"] > 1)
    changed[key] = [value + 1 for value in changed[key]] if key == "curve_psnr" else changed[key] + 1
    path.write_text("".join(f"{json.dumps(row)}\n" for row in rows), encoding="utf-8")
    assert set(stale(copied, copied)) == becomes
    for name in becomes:
        write(copied / name, pictures(copied)[name])
    assert stale(copied, copied) == []


@pytest.mark.parametrize("name", NAMES)
def test_a_figure_is_the_same_twice_and_names_who_is_in_it(tmp_path: Path, name: str) -> None:
    picture = pictures()[name]
    for again in ("a.svg", "b.svg"):
        write(tmp_path / again, picture)
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()
    root = ElementTree.fromstring((tmp_path / "a.svg").read_text(encoding="utf-8"))
    texts = {text.text for text in root.iter("{http://www.w3.org/2000/svg}text")}
    shown = {entry[0] for entry in picture.numbers}
    assert texts >= ({entry for entry in shown if entry in NAMED} if name != "quality-time.svg" else shown)


def test_points_are_means_over_seeds_and_whoever_sends_nothing_has_none() -> None:
    rows = read_rows("protocol", PAGES)
    found = {point.name: point for point in points_of(rows, "kb")}
    assert set(found) == {row["name"] for row in rows} - {"hold", "unpruned"}
    runs = [row for row in rows if row["name"] == "s2gs-edge"]
    assert found["s2gs-edge"].cost == pytest.approx(sum(run["kb"] for run in runs) / len(runs), abs=0.005)


def test_curves_are_means_over_seeds() -> None:
    rows = [{"name": "queen", "curve_psnr": values} for values in ([1.0, 2.0], [3.0, 5.0])]
    assert curves_of([*rows, {"name": "another"}]) == [("queen", [2.0, 3.5])]
