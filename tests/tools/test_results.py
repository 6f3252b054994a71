"""Tables of the results pages: as their data say, and refused where there are none."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from gsstream.core.errors import InputError
from tools.results import PAGES, TABLE, fill, filled, read_rows, table_of

RUN = {"scene": "a", "name": "edge", "seed": 0, "frames": 3, "psnr": 30.0, "kb": 2.0}


def test_tables_of_the_pages_are_made_from_their_data() -> None:
    assert [page.name for page in fill(PAGES, check=True)] == []
    pages = [page.read_text(encoding="utf-8") for page in PAGES.glob("*.md")]
    assert sum(len(TABLE.findall(text)) for text in pages) > 0
    assert sum(text.count("<!-- rows of ") for text in pages) == sum(len(TABLE.findall(text)) for text in pages)
    known = {path.stem for path in (PAGES / "data").glob("*.jsonl")}
    used = {name.strip() for text in pages for found in TABLE.finditer(text) for name in found["files"].split(",")}
    assert known == used, "data that no page shows, or the other way round"


def test_the_table_of_the_readme_is_that_of_the_published_protocol() -> None:
    rows = {row["name"]: row for row in read_rows("protocol-peers", PAGES)}
    text = (PAGES.parents[1] / "README.md").read_text(encoding="utf-8")
    table = text.split("## Numbers", 1)[1].split("## ", 1)[0]
    lines = [line.replace("*", "").split("|")[1:-1] for line in table.splitlines() if line.startswith("| ")][1:]
    assert len(lines) >= 5
    for name, *numbers in lines:
        row = rows[name.split("`")[1]]
        found = [row["psnr"], row["psnr_changed"], row["kb"], row["cpu_seconds"]]
        expected = [f"{value:{form}}" for value, form in zip(found, (".2f", ".2f", ".1f", ".1f"), strict=True)]
        assert [number.strip() for number in numbers] == expected, name


def test_seeds_are_one_line_and_what_was_not_measured_is_a_dash() -> None:
    rows = [RUN, {**RUN, "seed": 1, "psnr": 31.0}, {**RUN, "name": "full"}, {**RUN, "frames": 9}]
    table = table_of(rows, ["psnr", "flip"]).splitlines()
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in table]
    assert lines[0] == ["run", "frames", "seeds", "PSNR, dB", "FLIP"]
    assert lines[2:] == [
        ["`edge`", "3", "2", "30.50 ± 0.71", "-"],
        ["`full`", "3", "1", "30.00", "-"],
        ["`edge`", "9", "1", "30.00", "-"],
    ]
    assert "recording" in table_of([RUN, {**RUN, "scene": "b"}], ["kb"])


def test_a_number_changed_by_hand_is_found_and_put_back(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "some.jsonl").write_text(json.dumps(RUN) + "\n")
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- rows of some: psnr kb -->\n<!-- end of rows -->\nafter\n")
    assert fill(tmp_path, check=False) == [page]
    sound = page.read_text()
    assert "30.00" in sound
    assert sound.startswith("before\n")
    assert sound.endswith("\nafter\n")
    assert fill(tmp_path, check=True) == []
    page.write_text(sound.replace("30.00", "31.00"))
    assert fill(tmp_path, check=True) == [page]
    assert "31.00" in page.read_text(), "looking changes nothing"
    fill(tmp_path, check=False)
    assert page.read_text() == sound


@pytest.mark.parametrize(
    ("head", "said"), [("nowhere: psnr", "found no file"), ("nowhere: colour", "unknown quantities \\['colour'\\]")]
)
def test_rows_and_quantities_that_are_not_there_are_refused(tmp_path: Path, head: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        filled(f"<!-- rows of {head} -->\n<!-- end of rows -->", tmp_path)
