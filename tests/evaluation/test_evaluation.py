"""Evaluation, summaries, contact sheets and plots, on streams small enough to work out by hand."""

from __future__ import annotations

import itertools
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from gsstream.core.cameras import Cameras
from gsstream.core.changes import Delta, Layout, Residual
from gsstream.core.errors import InputError
from gsstream.core.frame import Frame
from gsstream.core.gaussians import Gaussians
from gsstream.engine.run.metrics_log import last_written, trim_metrics
from gsstream.engine.run.progress import frame_line
from gsstream.evaluation.contact_sheet import Column, contact_sheet, most_changed_window, sheet_of_stream
from gsstream.evaluation.evaluate import Evaluation, ViewQuality, evaluate
from gsstream.evaluation.gallery import drift_line, lamp_line
from gsstream.evaluation.plots import plot_runs
from gsstream.evaluation.records import FrameRecord, read_lines, read_records
from gsstream.evaluation.summary import Summary, fitted, format_table, later_keys_line, summarise, summary_table
from gsstream.input.recordings.base import SourceInfo
from gsstream.packet import KeyState, StreamMeta, StreamWriter, encode_delta, encode_empty, encode_key
from gsstream.player.playback import Playback
from gsstream.player.render import PlayerRenderer, render
from gsstream.player.software import render_numpy

NUMPY = PlayerRenderer("numpy", render_numpy)


def make_rig():
    viewmats = np.tile(np.eye(4), (3, 1, 1))
    viewmats[:, 2, 3] = 3
    viewmats[:, 0, 3] = [0, 0.2, -0.2]
    K = np.array([[50.0, 0, 24], [0, 50, 20], [0, 0, 1]])
    return Cameras(("a", "b", "c"), viewmats, np.tile(K, (3, 1, 1)), 48, 40)


def make_stream(path):
    """40 blobs; at frames 1 and 3 the first two jump to the right."""
    rng, rig = np.random.default_rng(0), make_rig()
    number = 40
    scene = Gaussians(
        means=(0.5 * rng.normal(size=(number, 3))).astype(np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (number, 1)),
        scales=np.full((number, 3), -2, np.float32),
        opacities=np.full(number, 2, np.float32),
        sh0=rng.normal(size=(number, 1, 3)).astype(np.float32),
        shN=np.zeros((number, 0, 3), np.float32),
    )
    meta = StreamMeta("dense", "test", {}, rig.select([0]), rig.select([1, 2]), 30.0, (0.3, 0.3, 0.3))
    layout = Layout(np.int32([2, 18, 10, 10]), np.zeros(number, np.uint8), np.float32([1]))
    jump = np.zeros((2, 3), np.int32)
    jump[:, 0] = 4
    delta = Delta((Residual(np.array([1, 0, 0, 0], np.uint8), 1, {"means": jump}, {"means": 0.1}),))
    with StreamWriter.open(path) as writer:
        writer.append(encode_key(KeyState(scene, layout, meta)))
        for frame in (1, 2, 3):
            packet = encode_empty(frame=frame) if frame == 2 else encode_delta(delta, layout, {}, frame=frame)
            writer.append(packet)
    return path


class Rendered:
    """A recording made of the stream's own renders plus noise, its test cameras in another order."""

    def __init__(self, stream, noise=0.0, order=(2, 1)):
        self._noise, rig = noise, make_rig()
        self.info = SourceInfo("rendered", "memory", 4, 30.0, rig.select([0]), rig.select(order))
        with Playback(stream) as playback:
            self._scenes = [scene for _, scene in playback]
            self._background = playback.meta.background

    def frame(self, index, split="train"):
        rig = self.info.test if split == "test" else self.info.train
        images = [render(self._scenes[index], rig, view, self._background, NUMPY) for view in range(len(rig))]
        rng = np.random.default_rng(index)
        noisy = np.clip(images, 0, 1) + self._noise * rng.normal(size=np.shape(images))
        return Frame(index, index / 30, noisy.astype(np.float32), rig)

    def points(self, kind="recording"):
        return None

    def close(self):
        pass


def test_a_perfect_stream_beats_holding_frame_0(tmp_path):
    stream = make_stream(tmp_path / "s.gss")
    result = evaluate(stream, Rendered(stream), renderer=NUMPY)
    assert [(v.frame, v.camera) for v in result.views] == [(t, c) for t in range(4) for c in ("b", "c")]
    for view in result.views:
        assert view.psnr == math.inf
        assert view.ssim == pytest.approx(1)
        moved = view.frame > 0
        assert (view.moving_share > 0) == moved
        assert math.isfinite(view.static_psnr) == moved
        if moved:
            assert view.static_psnr_moving < view.static_psnr < 50
            assert view.psnr_moving == math.inf
            assert view.psnr_changed == math.inf
            # Where something moves is where holding is worst, the more so without the rim.
            assert view.static_psnr_changed < view.static_psnr_moving
    assert result.series("static_psnr")[3] < result.series("static_psnr")[1] == result.series("static_psnr")[2]


def test_noise_gives_the_psnr_and_sigma_it_must(tmp_path):
    stream = make_stream(tmp_path / "s.gss")
    result = evaluate(stream, Rendered(stream, noise=0.02), renderer=NUMPY)
    assert np.mean([v.psnr for v in result.views]) == pytest.approx(-20 * math.log10(0.02), abs=0.15)
    assert result.sigmas["b"] == pytest.approx(0.02, rel=0.25)
    assert all(v.moving_share < 0.02 for v in result.views if v.frame == 0)
    data = json.loads(result.to_json())
    assert "zero padding" in data["ssim_variant"]
    assert len(data["views"]) == 8
    assert data["views"][0]["psnr_moving"] is None
    table = result.table()
    assert table.splitlines()[2].startswith("| decoded")
    assert "frame 0 held" in table


def test_evaluation_of_some_frames_and_of_training_views(tmp_path):
    stream = make_stream(tmp_path / "s.gss")
    ticks = []
    result = evaluate(
        stream, Rendered(stream), frames=[3, 1], split="train", renderer=NUMPY, progress=lambda *t: ticks.append(t)
    )
    assert [(v.frame, v.camera) for v in result.views] == [(1, "a"), (3, "a")]
    assert ticks == [(1, 2), (2, 2)]


def test_a_recording_that_does_not_fit_is_refused(tmp_path):
    stream = make_stream(tmp_path / "s.gss")
    with pytest.raises(InputError, match="does not fit"):
        evaluate(stream, Rendered(stream, order=(2, 0)), renderer=NUMPY)
    with pytest.raises(InputError, match="nothing to evaluate"):
        evaluate(stream, Rendered(stream), frames=[], renderer=NUMPY)


def records():
    first = FrameRecord(0, {"x": 30.0, "y": 32.0}, bytes={"layout": 500, "means": 99_500}, seconds={"root": 60.0})
    later = [
        FrameRecord(
            t,
            {"x": 30.0 - t, "y": 31.0 - t},
            {"x": 0.9},
            {"x": 20.0} if t > 1 else {},
            {"gates": 1000 * t, "header": 16},
            {"confidence": 0.5, "optimise": 1.5},
            10 * t,
            100,
            t,
            10,
            100.0 * t,
            {"x": 10.0 * t} if t > 1 else {},
        )
        for t in (1, 2, 3)
    ]
    return [first, *later]


def test_summary_follows_the_definitions():
    s = summarise(records())
    assert (s.frames, s.psnr_first, s.psnr, s.ssim, s.psnr_moving) == (4, 31.0, 28.5, 0.9, 20.0)
    assert s.psnr_changed == 25.0
    assert s.psnr_slope == pytest.approx(-100)
    assert s.kb_per_frame == pytest.approx(2.016)
    assert (s.key_kb, s.seconds_first, s.seconds) == (100.0, 60.0, 2.0)
    assert s.kb_amortised == pytest.approx((100_000 + 6048) / 4000)
    assert s.sent == pytest.approx(0.2)
    assert s.gates == pytest.approx(0.2)
    assert s.gates_per_sent == pytest.approx(0.1)
    assert s.peak_memory_mb == 300.0


def test_later_key_packets_are_not_delta_packets():
    run = records()
    run.append(FrameRecord(4, bytes={"layout": 1, "means": 50_000}))
    assert summarise(run).kb_per_frame == summarise(run[:-1]).kb_per_frame
    assert summarise(run).kb_amortised > summarise(run[:-1]).kb_amortised * 0.9


def test_there_is_no_drift_across_a_later_key_packet_which_is_listed():
    run = records()
    assert later_keys_line(run) == ""
    assert math.isfinite(summarise(run).psnr_slope)
    run[2] = replace(run[2], bytes={"layout": 1, "means": 124_999})
    assert math.isnan(summarise(run).psnr_slope)
    assert later_keys_line(run) == "later key packets: frame 2 (125.0 KB)"
    many = [run[0], *(replace(run[2], frame=frame) for frame in range(1, 10))]
    assert later_keys_line(many).endswith("frame 6 (125.0 KB) and 3 more")
    whole = Evaluation(tuple(ViewQuality(t, "a", 30.0 + t, 0.9, 30.0, 1.0, 20.0, 0.5, 20.0) for t in range(4)), {}, "r")
    drift = [line.split("|")[4].strip() for line in whole.table().splitlines()[2:4]]
    assert drift[0] == "+100.00"
    for key, shown in ((0, "+100.00"), (1, "-"), (3, "-"), (4, "+100.00")):
        rows = replace(whole, later_keys=(key,)).table().splitlines()
        assert [line.split("|")[4].strip() for line in rows[2:4]] == [shown, drift[1]]


def test_a_camera_that_drifted_is_named_with_its_last_gain() -> None:
    """Lines without one are of frames in which no camera got another gain."""
    lines = [
        {"frame": 5, "camera_drift": [[0.0, 0.0, 0.0], [-1.0, -1.0, -1.0], [0.0, 0.0, 0.0]]},
        {"frame": 10, "camera_drift": [[0.0, 0.0, 0.0], [-2.04, -2.0, -2.0], [0.0, 0.0, 0.31]]},
        {"frame": 11},
    ]
    wanted = "cameras that became brighter or darker alone: b -2.0/-2.0/-2.0 %, c +0.0/+0.0/+0.3 %; fix their exposure"
    assert drift_line(lines, ["a", "b", "c"]) == wanted
    assert drift_line(lines[2:], ["a", "b", "c"]) == ""


def test_lamps_are_told_by_their_frames_and_not_without_end() -> None:
    lines = [{"frame": 0}, {"frame": 1, "lamp": [1.25, 0.5, 1.0]}, {"frame": 2}]
    assert lamp_line(lines) == "everything became brighter or darker at once: frame 1 x 1.25/0.50/1.00"
    assert lamp_line(lines[2:]) == ""
    many = [{"frame": frame, "lamp": [1.5, 1.5, 1.5]} for frame in range(9)]
    assert lamp_line(many).endswith("frame 5 x 1.50/1.50/1.50 and 3 more")


def test_what_was_not_measured_is_a_dash():
    row = summary_table({"only frame 0": summarise([FrameRecord(0)])}).splitlines()[2]
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert cells == ["only frame 0", "1", *["-"] * 15]


def test_records_round_trip_and_survive_a_killed_run(tmp_path):
    path = tmp_path / "metrics.jsonl"
    line = {
        "frame": 1,
        "psnr": {"x": 30.5, "y": None},
        "psnr_changed": {"x": 20.5, "y": None},
        "bytes": {"gates": 7},
        "novelty": [1, 2],
        "num_gates": 3,
        "open_gates": [5, 4],
    }
    path.write_text(json.dumps({"frame": 0}) + "\n\n" + json.dumps(line) + "\n" + '{"frame": 2, "psn')
    read = read_records(tmp_path)
    assert [r.frame for r in read] == [0, 1]
    assert (read[1].psnr, read[1].total_bytes, read[1].num_gates) == ({"x": 30.5}, 7, 3)
    assert read[1].psnr_changed == {"x": 20.5}
    assert read[1].open_gates == (5, 4)
    assert math.isnan(read[1].peak_memory_mb)


def test_a_file_cut_anywhere_loses_its_last_line_alone_for_every_reader(tmp_path):
    path, lines = tmp_path / "metrics.jsonl", [{"frame": f, "psnr": {"x": 30.0 + f}} for f in range(3)]
    whole = "".join(json.dumps(line) + "\n" for line in lines)
    first = len(json.dumps(lines[0]))
    for end in range(first, len(whole) + 1):
        path.write_text(whole[:end])
        kept = [line for line in lines if whole.index(json.dumps(line)) + len(json.dumps(line)) <= end]
        assert read_lines(path) == kept
        assert [r.psnr["x"] for r in read_records(path)] == [line["psnr"]["x"] for line in kept]
        assert last_written(path) == len(kept) - 1
        assert trim_metrics(path, 1) == kept[:2]
        assert path.read_text() == "".join(json.dumps(line) + "\n" for line in kept[:2])
    assert last_written(tmp_path / "elsewhere") == -1
    assert trim_metrics(tmp_path / "elsewhere", 5) == []


def test_a_damaged_line_is_not_dropped_when_a_run_goes_on(tmp_path):
    path, text = tmp_path / "metrics.jsonl", '{"frame": 0}\n{"fr\n{"frame": 2}\n'
    path.write_text(text)
    with pytest.raises(InputError, match=r"metrics.jsonl:2: .*mend or remove the line"):
        trim_metrics(path, 2)
    assert path.read_text() == text


def test_a_frame_written_again_after_resuming_counts_once(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_text("\n".join(json.dumps({"frame": f, "num_gates": n}) for f, n in ((0, 1), (1, 1), (1, 5))))
    assert [(r.frame, r.num_gates) for r in read_records(path)] == [(0, 1), (1, 5)]


BAD = [
    ("", "no frame"),
    ('{"psnr": {}}\n{"frame": 1}', ":1:"),
    ("[]\n{}", ":1:"),
    ('{"frame": 0}\n{"fra\n{"frame": 1}', ":2:"),
    ('{"frame": 0}\n[1]', ":2:"),
    ('{"frame": 0}\n{"frame": "1"}', ":2:"),
    ('{"frame": 0, "bytes": 3}', ":1:"),
]


@pytest.mark.parametrize(("text", "message"), BAD)
def test_bad_records_are_named_by_line(tmp_path, text, message):
    path = tmp_path / "metrics.jsonl"
    path.write_text(text)
    with pytest.raises(InputError, match=message):
        read_records(path)
    with pytest.raises(InputError, match="cannot read"):
        read_records(tmp_path / "elsewhere")


def test_contact_sheet_shows_truth_decoded_error_and_gates(tmp_path):
    stream = make_stream(tmp_path / "s.gss")
    out = sheet_of_stream(stream, Rendered(stream), [0, 1, 2], tmp_path / "sheet.png", camera="c", renderer=NUMPY)
    sheet = np.asarray(Image.open(out)).astype(int)
    left, top = sheet.shape[1] - 8 - 3 * 52, 36
    rows, columns = (slice(top + r * 44, top + r * 44 + 40) for r in range(4)), range(3)
    cell = [[sheet[row, left + c * 52 : left + c * 52 + 48] for c in columns] for row in rows]
    for column in range(3):
        assert np.array_equal(cell[0][column], cell[1][column])
        assert cell[2][column].max() == 0
    assert not np.array_equal(cell[0][0], cell[0][1])
    orange = [c[..., 0] > c[..., 2] + 60 for c in cell[3]]
    assert orange[1].sum() > 20  # the blobs that jumped
    assert orange[2].sum() == 0  # nothing was allowed to change
    assert (cell[3][0] == 255).all()  # frame 0 has no gates


def test_the_close_up_is_where_most_pixels_changed():
    """Against every window, one by one."""
    draw = np.random.default_rng(3)
    first, truth = np.zeros((31, 44, 3), np.float32), np.zeros((31, 44, 3), np.float32)
    assert most_changed_window(truth, first) is None
    truth[draw.random((31, 44)) < 0.05] = 0.5
    truth[20:, 30:][draw.random((11, 14)) < 0.6] = 0.5
    rows, columns = most_changed_window(truth, first)
    changed = (truth > 0.1).any(-1)
    counts = {(y, x): changed[y : y + 10, x : x + 14].sum() for y, x in itertools.product(range(22), range(31))}
    assert changed[rows, columns].shape == (10, 14)
    assert changed[rows, columns].sum() == max(counts.values())


def test_contact_sheet_shows_the_fresh_reconstruction_close_up_where_there_is_one(tmp_path):
    truth, stream, fresh = (np.full((30, 45, 3), value, np.float32) for value in (0.2, 0.4, 0.6))
    part = (slice(3, 13), slice(5, 20))
    with_fresh = Column("a", truth, stream, fresh=fresh, close=part)
    sheet = np.asarray(contact_sheet([with_fresh, Column("b", truth, stream)])).astype(int)
    plain = np.asarray(contact_sheet([Column("b", truth, stream)])).astype(int)
    assert sheet.shape[0] - plain.shape[0] == 3 * 34, "three rows more, and none for the gates that nobody gave"
    left, top = sheet.shape[1] - 8 - 2 * 49, 18 + 3 * 34
    cells = [sheet[top + r * 34 : top + r * 34 + 30, left : left + 45] for r in range(3)]
    assert [cell.min() for cell in cells] == [cell.max() for cell in cells] == [51, 102, 153]


def test_contact_sheet_refuses_what_it_cannot_show(tmp_path):
    stream = make_stream(tmp_path / "s.gss")
    with pytest.raises(InputError, match="at least one"):
        contact_sheet([])
    with pytest.raises(InputError, match="nobody"):
        sheet_of_stream(stream, Rendered(stream), [0], tmp_path / "x.png", camera="nobody", renderer=NUMPY)
    with pytest.raises(InputError, match="not in the recording"):
        sheet_of_stream(stream, Rendered(stream, order=(1,)), [0], tmp_path / "x.png", camera="c", renderer=NUMPY)


def test_plots_have_a_panel_per_measured_quantity(tmp_path):
    full = np.asarray(Image.open(plot_runs({"one": records(), "two": records()[:3]}, tmp_path / "two.png", "runs")))
    bare = [FrameRecord(t, {"x": 30.0 + t}) for t in range(3)]
    small = np.asarray(Image.open(plot_runs({"bare": bare}, tmp_path / "bare.png")))
    assert full.shape[0] > 3 * small.shape[0]
    gated = [FrameRecord(t, {"x": 30.0 + t}, open_gates=(9, 5, 4)) for t in range(3)]
    assert np.asarray(Image.open(plot_runs({"gated": gated}, tmp_path / "gated.png"))).shape[0] > small.shape[0]
    blue = np.abs(small[..., :3].astype(int) - (0, 114, 178)).max(-1) < 40
    assert blue.sum() > 100
    with pytest.raises(InputError, match="nothing to plot"):
        plot_runs({"empty": [FrameRecord(0)]}, tmp_path / "none.png")


def test_large_pictures_are_reduced_on_the_sheet_and_close_ups_keep_their_pixels() -> None:
    """At 1352 pixels of width the sheet of five frames was 41 megapixels, and its words could not be read."""
    rng = np.random.default_rng(0)
    truth = rng.integers(0, 256, (301, 1352, 3)).astype(np.float32) / 255
    window = (slice(100, 200), slice(450, 900))
    sheet = np.asarray(contact_sheet([Column("large", truth, truth, close=window)])).astype(int)
    assert sheet.shape[1] < 700
    mean = truth[:300, :1350].reshape(100, 3, 450, 3, 3).mean((1, 3))
    exact = np.rint(truth[window] * 255).astype(int)
    for picture, bound in ((np.rint(mean * 255).astype(int), 1), (exact, 1)):
        windows = np.lib.stride_tricks.sliding_window_view(sheet, (1, 40, 3))[:, :, 0, 0]
        found = np.argwhere((np.abs(windows - picture[0, :40]) <= bound).all((2, 3)))
        assert len(found) >= 1
        row, column = found[0]
        part = sheet[row : row + 100, column : column + 450]
        assert np.abs(part - picture[:100, :450]).max() <= bound


CELLS = st.text("abc 0123.-", min_size=1, max_size=12).map(lambda text: text.strip() or "-")


def tables(columns: int) -> st.SearchStrategy[list[list[str]]]:
    return st.lists(st.lists(CELLS, min_size=columns, max_size=columns), min_size=2, max_size=4)


@given(rows=st.integers(1, 5).flatmap(tables), width=st.integers(1, 120))
def test_every_cell_is_there_and_what_fits_is_untouched(rows: list[list[str]], width: int) -> None:
    text = "\n".join(["before", format_table(rows), "", "after"])
    shown = fitted(text, width)
    if max(map(len, text.splitlines())) <= width:
        assert shown == text
    table = [line for line in shown.splitlines() if line.startswith("|") and not line.startswith("|-")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in table]
    assert cells in (rows, [list(column) for column in zip(*rows, strict=True)])
    assert shown.splitlines()[0] == "before"
    assert shown.splitlines()[-1] == "after"


def summary(frames: int, kb: float) -> Summary:
    return Summary(frames, 25.0, 24.0, -47.69, 0.9, 23.0, kb, 9.0, 3.0, 10.0, 1.0, 0.1, 0.1, 300.0, math.nan)


def test_a_run_stands_in_eighty_columns() -> None:
    shown = fitted(summary_table({"s2gs-fast + gate=always-open, stream.epochs=3": summary(12, 3.0)}), 80)
    assert max(map(len, shown.splitlines())) <= 80
    assert "KB/frame" in shown


def test_numbers_that_say_nothing_are_not_shown() -> None:
    assert "-47.69" not in summary_table({"r": summary(3, 3.0)})
    assert "-47.69" in summary_table({"r": summary(10, 3.0)})
    assert "0.016" in summary_table({"r": summary(3, 0.016)})
    line = {"frame": 1, "bytes": {"header": 16}, "seconds": {"code": 0.1}, "num_gaussians": 0, "sent_gaussians": 0}
    assert "16 B" in frame_line(line, 3)
