"""Tables of the results pages: as their data say, and refused where there are none."""

from __future__ import annotations

import json
import re
import statistics
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import pytest
from gsstream_lab.report.groups import Run

from gsstream.core.errors import InputError
from gsstream.encode import open_recording
from gsstream.evaluation.evaluate import evaluate
from tools.results import (
    FILLED,
    NUMBER,
    PAGES,
    PLANS,
    PRINTED,
    TABLE,
    fill,
    filled,
    merged,
    read_rows,
    rows_of_sweep,
    run,
    table_of,
    title_of,
    worst_camera,
)

RUN = {"scene": "a", "name": "edge", "seed": 0, "frames": 3, "psnr": 30.0, "kb": 2.0}


def test_tables_of_the_pages_are_made_from_their_data() -> None:
    assert [page.name for page in fill(FILLED, check=True)] == []
    pages = [page.read_text(encoding="utf-8") for page in FILLED]
    assert sum(len(TABLE.findall(text)) for text in pages) > 0
    assert sum(text.count("<!-- rows of ") for text in pages) == sum(len(TABLE.findall(text)) for text in pages)
    known = {path.stem for path in (PAGES / "data").glob("*.jsonl")}
    used = {name.strip() for text in pages for found in TABLE.finditer(text) for name in found["files"].split(",")}
    used |= {found["file"] for text in pages for found in NUMBER.finditer(text)}
    assert sum(text.count("<!-- end -->") for text in pages) == sum(len(NUMBER.findall(text)) for text in pages)
    used = {name for name in used if not name.startswith(PRINTED)}
    assert known == used, "data that no page shows, or the other way round"


#: What is measured, as it stands in a sentence.
MEASURED = re.compile(r"\d[\d.,]*\s(?:dB|KB|MB|GB|%|ms|s a frame|times (?:the|as))\b")


@pytest.mark.parametrize("page", FILLED, ids=lambda page: page.stem)
def test_no_table_of_numbers_and_no_measured_number_stands_without_data(page: Path) -> None:
    text = page.read_text(encoding="utf-8").split("## Estimated")[0]
    prose = NUMBER.sub("", TABLE.sub("", re.sub(r"^    .*$|```.*?```", "", text, flags=re.M | re.S)))
    if page.parent == PAGES:  # elsewhere a table may say 20 passes
        assert [line for line in prose.splitlines() if line.startswith("|") and re.search(r"\b\d", line)] == []
    assert MEASURED.findall(prose) == []


def test_the_table_of_the_readme_is_that_of_the_published_protocol() -> None:
    rows: dict[str, list[dict[str, float]]] = {}
    for row in read_rows("protocol", PAGES):
        rows.setdefault(row["name"], []).append(row)
    text = (PAGES.parents[1] / "README.md").read_text(encoding="utf-8")
    table = text.split("## Numbers", 1)[1].split("## ", 1)[0]
    lines = [line.replace("*", "").split("|")[1:-1] for line in table.splitlines() if line.startswith("| ")][1:]
    assert len(lines) >= 5
    for name, *numbers in lines:
        runs = rows[name.split("`")[1]]
        assert len(runs) >= 2, name
        keys = ("psnr", "psnr_changed", "kb", "cpu_seconds")
        found = [statistics.fmean(run[key] for run in runs) for key in keys]
        expected = [f"{value:{form}}" for value, form in zip(found, (".2f", ".2f", ".1f", ".1f"), strict=True)]
        assert [number.strip() for number in numbers] == expected, name
    printed = {float(row["PSNR_dB"]) for row in read_rows("printed-panoptic", PAGES)}
    assert {float(number) for number in re.findall(r"\b(\d+\.\d+) dB\b", table)} == printed


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


def test_rows_without_a_name_are_a_line_each_and_show_what_stands_in_them() -> None:
    rows = [
        {"board": "a", "worst_ms": 3, "ms_code": 12.34, "dropped": 0},
        {"board": "b", "ms_code": 0.123, "dropped": 7},
    ]
    lines = [
        [part.strip() for part in line.strip("|").split("|")]
        for line in table_of(rows, ["board", "ms_code", "dropped"]).splitlines()
    ]
    assert lines[0] == ["board", "code, ms", "dropped"]
    assert lines[2:] == [["a", "12", "0"], ["b", "0", "7"]]


def page_of(folder: Path, rows: list[dict[str, object]], text: str) -> str:
    """A page filled in from a data file called ``some``."""
    (folder / "data").mkdir()
    (folder / "data" / "some.jsonl").write_text("".join(f"{json.dumps(row)}\n" for row in rows))
    return filled(text, folder)


def test_a_table_may_show_some_names_in_an_order_of_its_own(tmp_path: Path) -> None:
    rows = [{**RUN, "name": name} for name in ("a", "b x=1", "c")]
    text = page_of(tmp_path, rows, "<!-- rows of some, only c b~x=1: psnr -->\n<!-- end of rows -->")
    assert [line.split("|")[1].strip() for line in text.splitlines()[3:-1]] == ["`c`", "`b x=1`"]
    with pytest.raises(InputError, match="only \\['d'\\]: there are no such rows; known: \\['a'"):
        filled("<!-- rows of some, only d: psnr -->\n<!-- end of rows -->", tmp_path)


def test_numbers_in_sentences_are_means_differences_and_ratios(tmp_path: Path) -> None:
    rows = [
        RUN,
        {**RUN, "seed": 1, "psnr": 30.5},
        {**RUN, "name": "full", "psnr": 29.0, "kb": 31.0},
        {**RUN, "scene": "b", "psnr": 20.0},
    ]
    text = (
        "<!-- some: a/edge psnr --><!-- end --> dB, <!-- some: full psnr - a/edge -->9<!-- end --> dB less for "
        "<!-- some: full kb / a/edge --><!-- end --> times"
    )
    found = page_of(tmp_path, rows, text)
    assert NUMBER.sub(r"\g<value>", found) == "30.25 dB, 1.00 dB less for 16 times", "compared on the seeds of both"
    with pytest.raises(InputError, match="expected one such number a seed in some"):
        filled("<!-- some: nobody psnr --><!-- end -->", tmp_path)


def test_a_curve_that_needs_half_of_the_bytes_has_a_bd_rate_of_minus_fifty(tmp_path: Path) -> None:
    """Points that a cheaper one beats do not count, and runs of another first word are not of the curve."""
    rows = [
        {**RUN, "name": f"{name} x={place}", "kb": factor * kb, "psnr": psnr}
        for name, factor in (("all", 1.0), ("half", 0.5))
        for place, (kb, psnr) in enumerate([(1.0, 30.0), (2.0, 31.0), (4.0, 32.0), (5.0, 29.0)])
    ]
    rows.append({**RUN, "name": "halfway x=1", "kb": 100.0, "psnr": 31.0})
    found = page_of(tmp_path, rows, "<!-- some: half psnr % all --><!-- end --> %")
    assert NUMBER.sub(r"\g<value>", found) == "-50 %"


def test_what_changed_in_a_frame_and_is_seen_is_that_of_an_evaluation(tmp_path: Path) -> None:
    """The sweep measured while it ran; here its stream is decoded once more."""
    plan = tmp_path / "plan.yaml"
    settings = "{first_frame.max_iterations: 20, stream.epochs: 1}"
    scenes = "scenes:\n  - {name: demo, uri: demo, frames: 6}\n"
    plan.write_text(
        f"name: small\nsplit: reporting\n{scenes}variants:\n  - {{name: edge, method: s2gs-edge, set: {settings}}}\n"
    )
    program = [sys.executable, "-c", "from gsstream.cli.main import main; main()"]
    subprocess.run([*program, "sweep", str(plan), "--out", str(tmp_path / "out")], check=True, capture_output=True)
    (row,) = rows_of_sweep(tmp_path / "out", "abc", at=[5], curve=True)
    (stream,) = (tmp_path / "out" / "cells").glob("*.gss")
    with open_recording("demo") as source:
        views = [asdict(view) for view in evaluate(stream, source).views]
    assert row["frame_5"] == pytest.approx(views[5]["psnr_changed_seen"], rel=1e-5)
    assert row["curve_psnr"] == pytest.approx([view["psnr"] for view in views], abs=0.006)
    assert row["ms_decode"] > 0
    assert row["frame_0_of"] == row["name"]
    assert row["psnr_seen"] == pytest.approx(sum(view["psnr_seen"] for view in views[1:]) / 5, rel=1e-5)


def test_the_worst_camera_is_that_of_the_mean_over_frames() -> None:
    """Not the mean over frames of the worst in each; the first frame is not among them."""
    frames = [{"p": {"a": 0.0, "b": 50.0}}, {"p": {"a": 30.0, "b": 20.0}}, {"p": {"a": 10.0, "b": 24.0}}]
    made = Run("x", 0, {"frames": [*frames, {"p": {"a": None, "b": 25.0}}]}, (), {})
    assert worst_camera(made, "p") == {"worst_p": 20.0}
    assert worst_camera(made, "q") == {}
    assert title_of("worst_psnr_changed_seen") == f"{title_of('psnr_changed_seen')}, worst camera"


def test_rows_taken_twice_keep_the_commit_that_ran_them() -> None:
    ran = {**RUN, "recipe": "r", "date": "monday", "commit": "a"}
    old = [ran, {**ran, "name": "gone"}, {"by": "hand"}]
    new = [{**RUN, "date": "monday", "commit": "b"}, {**RUN, "seed": 1, "date": "tuesday", "commit": "b"}]
    assert [(row["name"], row["seed"], row["commit"]) for row in merged(old, new)] == [
        ("edge", 0, "a"),
        ("gone", 0, "a"),
        ("edge", 1, "b"),
    ]
    again = [{**RUN, "date": "tuesday", "commit": "b", "psnr": 31.0}]
    assert merged(old, again)[0]["commit"] == "b"


def test_every_plan_has_its_name_and_every_table_of_runs_its_plan() -> None:
    for plan in PLANS.glob("*.yaml"):
        assert f"name: {plan.stem}\n" in plan.read_text(encoding="utf-8"), plan
    for path in (PAGES / "data").glob("*.jsonl"):
        if "recipe" in read_rows(path.stem, PAGES)[0]:
            assert (PLANS / f"{path.stem}.yaml").is_file(), path


def test_a_tree_that_no_commit_names_runs_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def git(*command: str) -> None:
        subprocess.run(["git", "-c", "user.name=a", "-c", "user.email=a@b", *command], cwd=tmp_path, check=True)

    git("init", "-q")
    (tmp_path / "code.py").write_text("a = 1\n")
    git("add", "code.py")
    git("commit", "-qm", "first")
    (tmp_path / "code.py").write_text("a = 2\n")
    monkeypatch.setattr("tools.results.ROOT", tmp_path)
    with pytest.raises(InputError, match="commit first"):
        run(["demo"], tmp_path, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_number_changed_by_hand_is_found_and_put_back(tmp_path: Path) -> None:
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "some.jsonl").write_text(json.dumps(RUN) + "\n")
    page = tmp_path / "page.md"
    page.write_text("before\n<!-- rows of some: psnr kb -->\n<!-- end of rows -->\nafter\n")
    assert fill([page], check=False, folder=tmp_path) == [page]
    sound = page.read_text()
    assert "30.00" in sound
    assert sound.startswith("before\n")
    assert sound.endswith("\nafter\n")
    assert fill([page], check=True, folder=tmp_path) == []
    page.write_text(sound.replace("30.00", "31.00"))
    assert fill([page], check=True, folder=tmp_path) == [page]
    assert "31.00" in page.read_text(), "looking changes nothing"
    fill([page], check=False, folder=tmp_path)
    assert page.read_text() == sound


@pytest.mark.parametrize(
    ("head", "said"), [("nowhere: psnr", "found no file"), ("some: colour", "unknown quantities \\['colour'\\]")]
)
def test_rows_and_quantities_that_are_not_there_are_refused(tmp_path: Path, head: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        page_of(tmp_path, [RUN], f"<!-- rows of {head} -->\n<!-- end of rows -->")
