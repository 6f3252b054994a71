"""Reports: fronts, knees, ties and knobs on tables worked out by hand; the page needs nothing but itself."""

from __future__ import annotations

import json
import math
import re
from html.parser import HTMLParser
from pathlib import Path

import pytest
from gsstream_lab.report.build import build_report
from gsstream_lab.report.document import Picture, Table, to_html, to_markdown
from gsstream_lab.report.figures import floor_of, measured_costs
from gsstream_lab.report.fronts import effects, knee, pareto_front
from gsstream_lab.report.groups import is_tie, read_sweep_data, seed_noise, waited
from gsstream_lab.report.paper import beside_ours, paper_table
from gsstream_lab.report.quantities import BY_KEY
from gsstream_lab.sweep.drive import summary_line
from gsstream_lab.sweep.table import TableWriter
from hypothesis import given
from hypothesis import strategies as st

from gsstream.cli.main import run_command
from gsstream.core.errors import InputError, UnknownName

FLOATS = st.floats(-100, 100)
BASE, CHANGED = {}, {"stream.epochs": 9}


def make_table(folder: Path, cells, paper=None, failed=(), cpu=1.0) -> Path:
    """A table of two-frame runs: (scene, variant, axes, seed, dB, KB, s)."""
    folder.mkdir(parents=True)
    writer = TableWriter(folder)
    points = [
        {"cell": f"c{i}", "scene": c[0], "variant": c[1], "axes": c[2], "seed": c[3]} for i, c in enumerate(cells)
    ]
    points += [{"cell": f"f{i}", "scene": "a", "variant": "bad", "axes": {}, "seed": i} for i, _ in enumerate(failed)]
    config = {"name": "made up", "description": "Numbers < by hand", "scenes": [], "paper_tables": paper or {}}
    writer.append("plan", {"config": config, "points": points})
    facts = {
        "processor": "none",
        "processors_usable": 1,
        "gpu": None,
        "python": "3",
        "torch": "2",
        "code": "c",
        "distributions": {"gsstream": "0"},
    }
    writer.append("machine", {"id": "m", "facts": facts})
    for i, (_, _, _, seed, quality, kilobytes, seconds) in enumerate(cells):
        frames = [
            {
                "frame": t,
                "bytes": {"layout": 9000} if t == 0 else {"gates": round(1000 * kilobytes)},
                "seconds": {"code": seconds},
                "cpu_seconds": cpu * seconds,
                "num_gaussians": 10,
                "sent_gaussians": 5,
                "num_gates": 4,
                "active_gates": 2,
                "peak_memory_mb": 100.0,
                "psnr": {"x": quality, "y": quality + 2},
                "ssim": {"x": 0.9},
                "psnr_moving": {"x": quality - 5 if t else None},
            }
            for t in range(3)
        ]
        row = {
            "id": f"c{i}",
            "status": "done",
            "seed": seed,
            "machine": "m",
            "recipe": "r",
            "workers": 1,
            "threads": "1",
            "date": "today",
            "load_average": 0.5,
            "ssim_variant": "SSIM of the test",
            "frames": frames,
        }
        writer.append("cell", row)
    for i, reason in enumerate(failed):
        writer.append("cell", {"id": f"f{i}", "status": "failed", "error": reason})
    return folder


CELLS = [
    ("a", "v", BASE, 0, 30.0, 20.0, 1.0),
    ("a", "v", BASE, 1, 30.2, 20.0, 1.0),
    ("a", "v", CHANGED, 0, 31.1, 25.0, 2.0),
    ("a", "w", BASE, 0, 30.15, 10.0, 1.0),
    ("a", "x", BASE, 0, 29.0, 30.0, 3.0),
]


@given(st.lists(st.tuples(FLOATS, FLOATS), max_size=12))
def test_a_front_is_what_nobody_beats(points):
    front = pareto_front(points)
    assert len(set(front)) == len(front)

    def beaten(i: int) -> bool:
        cost, good = points[i]
        return any(c <= cost and g >= good and (c, g) != (cost, good) for c, g in points)

    values = {points[i] for i in front}
    assert values == {points[i] for i in range(len(points)) if not beaten(i)}
    assert [points[i][0] for i in front] == sorted(points[i][0] for i in front)


def test_a_front_passes_over_what_was_not_measured():
    assert pareto_front([(math.nan, 1), (1, math.nan), (2, 0)]) == [2]
    assert pareto_front([]) == []


def test_the_knee_is_where_more_cost_stops_to_pay():
    assert knee([(1, 20), (2, 29), (4, 30), (8, 30.5)]) == 1
    assert knee([(1, 20), (10, 21), (100, 22)]) is None, "a straight line has no knee"
    assert knee([(1, 20), (2, 30)]) is None
    assert knee([(0, 20), (1, 25), (2, 30)]) is None
    scaled = [(7 * cost, good / 3 + 5) for cost, good in [(1, 20), (2, 29), (4, 30), (8, 30.5)]]
    assert knee(scaled) == 1, "units do not matter"


def test_groups_have_means_spreads_and_noise(tmp_path):
    data = read_sweep_data(make_table(tmp_path / "t", CELLS, failed=["no"]))
    first = data.groups[0]
    assert [group.label for group in data.groups] == ["v", "v epochs=9", "w", "x"]
    assert first.mean("psnr") == pytest.approx(31.1)  # mean over cameras x and y = x + 1
    assert first.mean("psnr_moving") == pytest.approx(25.1)
    assert first.spread("psnr") == pytest.approx(math.sqrt(0.02))
    assert math.isnan(data.groups[1].spread("psnr"))
    assert (first.mean("kb"), first.mean("seconds"), first.mean("cpu_seconds")) == (20.0, 1.0, 1.0)
    assert (first.mean("key_kb"), first.mean("sent"), first.mean("gates")) == (9.0, 50.0, 0.002)
    assert first.mean("seconds_first") == 1.0
    assert math.isnan(first.mean("flip"))
    assert "flip" not in data.measured()
    noise = seed_noise(data.groups, "psnr")
    assert noise == pytest.approx(math.sqrt(0.02))
    changed, other = data.groups[1], data.groups[2]
    assert is_tie(first, other, "psnr", noise) is True
    assert is_tie(first, changed, "psnr", noise) is False
    assert is_tie(first, changed, "psnr", math.nan) is None
    assert list(data.failed) == ["a bad seed 0"]


def test_axes_that_end_alike_have_labels_of_their_own(tmp_path):
    cells = [
        ("a", "v", {"stream.epochs": 4, "gate.lr": 1}, 0, 30.0, 20.0, 1.0),
        ("a", "v", {"motion.params.epochs": 4}, 0, 31.0, 20.0, 1.0),
    ]
    data = read_sweep_data(make_table(tmp_path / "t", cells))
    assert [group.label for group in data.groups] == ["v stream.epochs=4 lr=1", "v motion.params.epochs=4"]


def test_what_a_knob_buys(tmp_path):
    data = read_sweep_data(make_table(tmp_path / "t", CELLS))
    found = {e.knob: e for e in effects(data.of("a"), ["psnr", "psnr_moving", "kb", "seconds"])}
    assert list(found) == ["stream.epochs=9", "variant w", "variant x"]
    epochs = found["stream.epochs=9"]
    assert epochs.deltas["psnr"] == pytest.approx(1.0)
    assert epochs.per("psnr", "kb") == pytest.approx(1.0 / 5)
    assert epochs.per("psnr", "seconds") == pytest.approx(1.0)
    assert epochs.verdict("psnr", "kb") == "buys"
    assert found["variant w"].verdict("psnr", "kb") == "cheaper, quality tied"
    assert math.isnan(found["variant w"].per("psnr", "kb"))
    assert found["variant x"].verdict("psnr", "kb") == "worse and dearer"


def test_a_report_holds_the_tables_numbers_and_nothing_from_the_network(tmp_path, capsys):
    folder = make_table(tmp_path / "t", CELLS, failed=["RecipeError: <b>bad</b> | worse\nmore"])
    assert run_command(["report", str(folder)]) == 0
    page = (folder / "report" / "report.html").read_text()
    text = (folder / "report" / "report.md").read_text()
    assert re.findall(r"""(?:src|href|url)\s*[=(]\s*['"]?(\w+):?""", page) == ["data", "data"]
    assert "http" not in re.sub(r"base64,[A-Za-z0-9+/=]+", "", page)
    assert "<script" not in page
    assert page.count('src="data:image/png;base64,') == 2
    assert "&lt;b&gt;bad&lt;/b&gt;" in page
    assert "Numbers &lt; by hand" in page
    assert "31.10 ± 0.14" in page
    assert "31.10 ± 0.14" in text
    assert "| v epochs=9 |     1 |" in text
    assert r"bad</b> \| worse" in text
    assert "SSIM of the test" in text
    assert "Not measured: energy" in text
    pictures = re.findall(r"!\[[^]]*\]\(([^)]+)\)", text)
    assert sorted(pictures) == ["a-frames.png", "a-pareto.png"]
    assert all((folder / "report" / name).read_bytes().startswith(b"\x89PNG") for name in pictures)
    assert "1 failed" in capsys.readouterr().err


def test_wall_time_of_a_busy_machine_is_in_no_front(tmp_path):
    calm, busy = (read_sweep_data(make_table(tmp_path / str(cpu), CELLS, cpu=cpu)).groups for cpu in (1.0, 0.5))
    assert not waited(calm)
    assert waited(busy)
    assert "seconds" in measured_costs(calm)
    assert measured_costs(busy) == ["kb", "cpu_seconds", "memory"]


def test_one_seed_calls_nothing_a_tie(tmp_path):
    blocks = build_report(read_sweep_data(make_table(tmp_path / "t", CELLS[1:])), {})
    assert any(isinstance(block, str) and "nothing is called a tie" in block for block in blocks)
    assert not any("~" in "".join(map("".join, b.rows)) for b in blocks if isinstance(b, Table))


def test_the_papers_numbers_stand_beside_ours_and_are_labelled(tmp_path):
    cells = [("a", "full", BASE, 0, 30.0, 20.0, 1.0), ("a", "ft-0.50", BASE, 0, 29.0, 10.0, 1.0)]
    data = read_sweep_data(make_table(tmp_path / "t", cells, paper={"propagation": {}}))
    table = beside_ours(paper_table("propagation"), data.of("a"), "a")
    rows = [list(row) for row in table.rows]
    assert "ENeRF" in table.caption
    assert "RTX 4090" in table.caption
    assert rows[1][:4] == ["full", "paper", "", "25.94"]
    assert rows[2][:4] == ["", "ours, a", "1", "31.00"]
    assert rows[2][4] == "-", "LPIPS was not measured"
    assert rows[0][-2:] == [BY_KEY["psnr_moving"].title, BY_KEY["cpu_seconds"].title]
    assert [row[1] for row in rows[1:]].count("paper") == 5
    assert table in build_report(data, {})


def test_a_row_of_the_paper_may_be_a_variant_of_another_name(tmp_path):
    cells = [("a", "1-dense", BASE, 0, 30.0, 20.0, 1.0)]
    data = read_sweep_data(make_table(tmp_path / "t", cells, paper={"structure-sparsity": {"neither": "1-dense"}}))
    table = next(b for b in build_report(data, {}) if isinstance(b, Table) and "Structure" in b.caption)
    assert [row[0] for row in table.rows[1:]] == ["neither", "", "sparsity", "structure", "both"]


@given(st.lists(st.floats(20, 40), min_size=1, max_size=30))
def test_an_axis_shows_the_better_three_quarters(values):
    floor = floor_of(values)
    assert min(values) <= floor <= max(values)
    assert sum(v >= floor for v in values) >= 0.7 * len(values)


def test_one_that_failed_does_not_flatten_the_others():
    good = [30.0, 30.1, 30.2, 30.4, 30.5]
    assert floor_of(good) == 30.0
    assert 29.5 < floor_of([*good, 12.0]) < 30.1


def test_the_papers_file_is_sound():
    import gsstream_lab.report.paper as module

    content = module.YAML(typ="safe", pure=True).load(module._FILE.read_text())
    for name in content["tables"]:
        table = paper_table(name)
        assert table.rows
        assert set(table.columns) <= set(BY_KEY), name
    files = {path.stem for path in (Path(__file__).parents[3] / "configs" / "paper").glob("*.yaml")}
    unprinted = {"full", "candidates", "campus", "testbed"}
    assert files - unprinted == set(content["tables"]), "every table has its sweep"
    with pytest.raises(UnknownName, match="did you mean 'components'"):
        paper_table("component")


def test_documents_escape_what_they_show():
    texts = ["## <x>", "a & b <b>c</b> [d](http://e)"]
    blocks = [*texts, Table("c|d", [["h"], ["<td>"]]), Picture("p.png", b"x", 'say "hi"')]
    page = to_html("<t>", blocks)
    assert "<x>" not in page
    assert "a &amp; b &lt;b&gt;c&lt;/b&gt; [d](http://e)" in page
    assert "&lt;td&gt;" in page
    assert '<img src="data:image/png;base64,eA==" alt="say &quot;hi&quot;" />' in page
    assert to_markdown("t", blocks).startswith("# t\n\n## <x>\n\na & b <b>c</b> [d](http://e)\n\n**c|d**")


class Requested(HTMLParser):
    """Notes every address that a browser would ask for, and every element that could run something."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.elements: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.add(tag)
        for name, value in attrs:
            assert not name.startswith("on"), f"{tag} {name}"
            if name == "style":
                assert value in ("text-align:left", "text-align:right"), value
            if name in ("src", "srcset", "href", "data", "poster", "action", "background", "content"):
                self.addresses.append(value or "")


HOSTILE = [
    "![x](http://evil.example/a.png)",
    "![x][1]\n\n[1]: http://evil.example/b.png",
    "[1]: http://evil.example/c.png",
    "![x](p.png)",
    "<img src=http://evil.example/d.png>",
    "<http://evil.example>",
    "[x](javascript:alert(1))",
    '"><script src="//evil.example/e.js"></script>',
    "<style>@import url(http://evil.example)</style>",
    "<svg><image href=http://evil.example/>",
    "<link rel=stylesheet href=http://evil.example>",
    "<iframe src=http://evil.example>",
    "http://evil.example/f.png",
    "`![x](http://evil.example/g.png)`",
    "> ![x](http://evil.example/h.png)",
    "1. ![x](http://evil.example/i.png)",
]


def test_no_text_makes_a_report_fetch_anything():
    """A description, a reason of a failure, a caption and what a picture shows are other people's text."""
    for text in HOSTILE:
        table = Table(text.replace("\n", " "), [["h", text], [text, "x"]])
        page = Requested()
        page.feed(to_html(text, [text, f"## {text}", table, Picture("p.png", b"x", text)]))
        assert [a for a in page.addresses if a != "width=device-width"] == ["data:image/png;base64,eA=="], text
        assert not page.elements & {"script", "a", "link", "iframe", "object", "base", "form", "svg", "image"}, text


def test_a_folder_without_results_says_so(tmp_path):
    folder = make_table(tmp_path / "t", [], failed=["x"])
    with pytest.raises(InputError, match="no cell has finished"):
        read_sweep_data(folder)
    (folder / "table.jsonl").write_text(json.dumps({"record": "machine", "id": "m"}) + "\n")
    with pytest.raises(InputError, match="holds no plan"):
        read_sweep_data(folder)


def evaluated(path: Path, quality: float, cameras: str = "xy", frames: int = 3) -> Path:
    """What ``evaluate --json`` writes: frame 0 is 3 dB better, nothing moves there, SSIM is of one camera."""
    views = [
        {
            "frame": t,
            "camera": camera,
            "psnr": quality + 2 * (camera == "y") + 3 * (t == 0),
            "psnr_moving": quality - 4 if t else None,
            "ssim": 0.8 if camera == "x" else None,
        }
        for t in range(frames)
        for camera in cameras
    ]
    path.write_text(json.dumps({"renderer": "pictures", "views": views}))
    return path


def test_rows_of_other_programs_stand_beside_ours(tmp_path, capsys):
    folder = make_table(tmp_path / "s", [("a", "edge", BASE, 0, 30.0, 5, 1)])
    mine = evaluated(tmp_path / "mine.json", 28.0)
    assert run_command(["report", str(folder), "--add", str(mine), "--add", f"theirs={mine}"]) == 0
    page = (folder / "report" / "report.md").read_text()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in page.splitlines() if "|" in line]
    (head,) = [row for row in rows if row[-1] == "drawn by"]
    for name in ("mine (added)", "theirs (added)"):
        (row,) = [row for row in rows if row[0] == name]
        found = dict(zip(head, row, strict=True))
        assert found["PSNR 0, dB"] == "32.00"
        assert found["PSNR, dB"] == "29.00"
        assert found["moving, dB"] == "24.00"
        assert found["SSIM"] == "0.8000"
        assert "LPIPS" not in found
        assert found["drawn by"] == "pictures"
    (ours,) = [row for row in rows if row[0] == "edge" and row[-1] == "the player"]
    assert dict(zip(head, ours, strict=True))["PSNR, dB"] == "31.00"


@pytest.mark.parametrize(
    ("other", "said"),
    [
        ({"cameras": "xz"}, "it has the test cameras x, z and 3 frames from 0"),
        ({"frames": 2}, "it has the test cameras x, y and 2 frames from 0"),
    ],
)
def test_rows_that_show_something_else_are_refused(tmp_path, capsys, other, said):
    folder = make_table(tmp_path / "s", [("a", "edge", BASE, 0, 30.0, 5, 1)])
    path = evaluated(tmp_path / "mine.json", 28.0, **other)
    assert run_command(["report", str(folder), "--add", str(path)]) == 2
    assert f"--add mine: {said}; expected those of a scene of this sweep (a)" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"views": []}', '{"views": [{"frame": 0}], "renderer": "r"}'])
def test_a_file_that_is_no_evaluation_is_refused(tmp_path, capsys, text):
    folder = make_table(tmp_path / "s", [("a", "edge", BASE, 0, 30.0, 5, 1)])
    (tmp_path / "x.json").write_text(text)
    assert run_command(["report", str(folder), "--add", f"n={tmp_path / 'x.json'}"]) == 2
    assert "expected what 'gsstream evaluate --json'" in capsys.readouterr().err
    assert run_command(["report", str(folder), "--add", str(tmp_path / "absent.json")]) == 2
    assert "No such file" in capsys.readouterr().err


def test_a_line_of_progress():
    frame = {"psnr": {"a": 30.0, "b": None}, "psnr_moving": {"a": None}, "bytes": {"x": 500}, "seconds": {"y": 0.25}}
    assert summary_line([{}, frame, frame]) == "30.00 dB (moving nan), 0.5 KB, 0.25 s/frame"
