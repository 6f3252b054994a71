"""`gsstream bench` as a user meets it: tiny runs, the JSON it writes, what it refuses. No assertion on times."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from gsstream_lab.bench.native import MEASURED, find_native, measure_peaks

from gsstream.cli.main import run_command

RENDER_KEYS = {
    "renderer", "level", "gaussians", "width", "height", "share", "tiles", "path", "rows", "drawn", "live_pairs",
    "pixels", "floats", "threads", "forward_ms", "backward_ms", "total_ms", "statistics", "roofline_ms", "ratio",
    "ratio_cpu",
}  # fmt: skip
FRAME_KEYS = {
    "sweep", "variant", "static", "gaussians", "moving", "changed_tiles", "status", "bytes", "psnr", "psnr_if_held",
    "total_ms", "phases_ms",
}  # fmt: skip


def measured(path: Path, *args: str) -> dict[str, Any]:
    assert run_command(["bench", *args, "--quick", "--out", str(path)]) == 0
    data: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    assert {"date", "processor", "processors_usable", "load_average", "torch"} <= set(data["machine"])
    return data


def test_render_without_compiled_renderers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("GSSTREAM_LOAD_PLUGINS", "lab")
    data = measured(tmp_path / "r.json", "render", "--renderers", "reference,missing", "--threads", "1")
    assert data["schema"] == "gsstream-bench-render-1"
    assert [case["renderer"] for case in data["cases"]] == ["reference"]
    (case,) = data["cases"]
    assert set(case) == RENDER_KEYS
    assert (case["roofline_ms"], case["ratio"], data["peaks"]) == (None, None, [])
    assert case["live_pairs"] == data["scenes"][0]["live_pairs"] > 0
    assert [skipped["renderer"] for skipped in data["skipped"]] == ["missing"]
    assert "missing" in data["skipped"][0]["why"]
    table = capsys.readouterr().out
    assert "| reference (part) |" in table
    assert "Peaks: not measured" in table
    assert "Not run: missing at all" in table


def test_render_with_the_cpu_renderer(tmp_path: Path) -> None:
    native = find_native("cpu")
    if native is None:
        pytest.skip("gsstream-cpu-render is not installed")
    before = native.num_threads()
    data = measured(tmp_path / "r.json", "render", "--renderers", "cpu", "--shares", "100,25", "--threads", "1,2")
    assert native.num_threads() == before
    assert [peak["threads"] for peak in data["peaks"]] == [1, 2]
    cases = {(c["level"], c["path"], c["share"], c["threads"]) for c in data["cases"]}
    paths = (("all rows", 1.0), ("all rows", 0.25), ("active rows", 0.25))
    assert cases == {(level, *path, n) for level in ("part", "kernel") for path in paths for n in (1, 2)}
    whole = next(c for c in data["cases"] if c["share"] == 1 and c["level"] == "kernel")
    for case in data["cases"]:
        assert set(case) == RENDER_KEYS
        assert 0 < case["total_ms"]["min"] <= case["total_ms"]["median"]
        assert case["ratio"] == pytest.approx(case["total_ms"]["min"] / case["roofline_ms"], rel=0.05)
        assert (case["statistics"] is None) == (case["level"] == "part")
        if case["share"] < 1:
            assert case["live_pairs"] < whole["live_pairs"]
            assert case["tiles"] < whole["tiles"]
        if case["path"] == "active rows":
            assert 0 < case["rows"] < case["gaussians"]
    # The renderer tests ellipses where the count tests boxes: it finds a few less.
    visible = data["scenes"][0]["visible"]
    assert 0.95 * visible <= whole["statistics"]["visible"] <= visible


def test_the_reference_renderer_is_left_out_where_it_would_take_minutes(tmp_path: Path) -> None:
    path = tmp_path / "r.json"
    data = measured(path, "render", "--renderers", "reference", "--sizes", "3000x160x120", "--threads", "1")
    assert data["cases"] == []
    assert [(s["renderer"], s["size"]) for s in data["skipped"]] == [("reference", "3k 160x120")]


def test_peaks_keep_the_better_of_two_measurements() -> None:
    class Machine:
        flops = iter([*[4.0] * 7, 10.0, *[5.0] * (MEASURED - 8), *[9.0] * MEASURED])
        bytes_ = iter([*[0.5] * (MEASURED // 4 - 1), 1.0, 3.0, *[2.0] * (MEASURED // 4 - 1)])

        def fma_peak(self, threads: int, seconds: float) -> float:
            return next(self.flops)

        def copy_peak(self, threads: int, megabytes: float) -> float:
            return next(self.bytes_)

    native: Any = Machine()
    once = measure_peaks(native, (1,), {})
    twice = measure_peaks(native, (1,), once)
    assert (once[1].gflops, once[1].gbytes_per_second) == (10.0, 1.0)
    assert (twice[1].gflops, twice[1].gbytes_per_second) == (10.0, 3.0)
    assert measure_peaks(None, (1,), {}) == {}


def test_frame_by_phase(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = measured(tmp_path / "f.json", "frame", "--method", "dense")
    assert data["schema"] == "gsstream-bench-frame-1"
    sweeps = [(case["sweep"], case["static"], case["variant"]) for case in data["cases"]]
    wanted = [("object moves", 400), ("25% of tiles", 400), ("0% of tiles", 400), ("object moves", 800)]
    assert sweeps == [(*case, variant) for case in wanted for variant in ("dense", "gated", "active")]
    for case in data["cases"]:
        assert set(case) >= FRAME_KEYS
        assert sum(phase["min"] for phase in case["phases_ms"].values()) <= 1.01 * case["total_ms"]["min"]
        assert case["gaussians"] == case["static"] + 100
    still = [case for case in data["cases"] if case["sweep"] == "0% of tiles"]
    assert all(case["changed_tiles"] == 0 and case["moving"] == 0 and case["psnr_if_held"] is None for case in still)
    patch = next(case for case in data["cases"] if case["sweep"] == "25% of tiles")
    assert 0.15 < patch["changed_tiles"] < 0.4
    assert 0 < patch["moving"] < patch["gaussians"]
    table = capsys.readouterr().out
    assert "| 25% of tiles |" in table
    assert "Method dense" in table


@pytest.mark.parametrize(
    ("args", "message"),
    [
        (["render", "--shares", "120"], "--shares: expected percentages from 0.01 to 100, got '120'"),
        (["render", "--shares", "x"], "--shares: expected percentages"),
        (["render", "--threads", "0"], "--threads: expected integers >= 1"),
        (["render", "--sizes", "100x20"], "--sizes: expected GAUSSIANSxWIDTHxHEIGHT, got '100x20'"),
        (["render", "--sizes", "100x2x2"], "--sizes: expected integers >= 8"),
        (["frame", "--size", "80"], "--size: expected WIDTHxHEIGHT, got '80'"),
        (["frame", "--static", "a"], "--static: expected integers >= 1, got 'a'"),
        (["frame", "--method", "denze"], "did you mean 'dense'?"),
        (["frame", "--method", "dense", "--set", "stream.epoch=1"], "stream.epoch"),
        (["render", "--out", "no/such/folder/r.json"], "cannot write"),
    ],
)
def test_mistakes_are_named(args: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_command(["bench", *args]) == 2
    assert message in capsys.readouterr().err
