"""Whatever a run was and wherever it was cut, it resumes to the bytes of a run that was not."""

from __future__ import annotations

import functools
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from flow_runs import arguments, broken_off_in, encode, growing, metrics, paused

from gsstream.cli.main import run_command
from gsstream.discovery.catalog import load_catalog
from gsstream.packet import StreamReader

WORLD = "synthetic:frames=5&views=3&width=32&height=24&supersample=1"
STILL = f"{WORLD}&static=1"
DIMMING = "synthetic:scene=dim&event=1&frames=16&views=3&width=48&height=32&supersample=1"
DRIFTING = "disturbed:drift=cam01@-0.02:" + DIMMING.replace("dim", "paths").replace("views=3", "views=4")
LAMP = DIMMING.replace("dim", "lamp").replace("event=1", "event=7")
FOLLOWED = {"stream__light": 0.5}
SMALL: dict[str, Any] = {
    "stream__epochs": 2,
    "first_frame__max_iterations": 8,
    "first_frame__max_points": 200,
}
Lines = list[dict[str, Any]]


class Run(NamedTuple):
    """One row: how the run is made, and the frame that it is cut at.

    ``prepare`` is given a folder and returns more of the command line; ``grows``: every second frame adds Gaussians and
    takes some away; ``shows``: whether the metrics of the whole run hold what the row is about.
    """

    at: int
    method: str = "s2gs-edge"
    source: str | Callable[[Path], Path] = WORLD
    flags: tuple[str, ...] = ()
    prepare: Callable[[Path], tuple[str, ...]] = lambda _: ()
    settings: dict[str, Any] = {}  # noqa: RUF012 (never written)
    grows: bool = False
    shows: Callable[[Lines], bool] = lambda lines: "delta" in [line["status"] for line in lines]


def dense_frame_0(folder: Path) -> tuple[str, ...]:
    """Frame 0 of another stream: the method groups it by its own structure, and must find the same groups again."""
    encode(folder / "dense", "--frames", "1", source=WORLD, **SMALL)
    return ("--first-frame", str(folder / "dense" / "stream.gss"))


def keys(lines: Lines) -> bool:
    return [line["status"] for line in lines].count("key") == 3


def drifts(lines: Lines) -> bool:
    """Whether a look before the cut and one after it told of a drift."""
    return {5, 10, 15} <= {line["frame"] for line in lines if "camera_drift" in line}


def lit_in(frame: int) -> Callable[[Lines], bool]:
    """Whether that frame alone says that a lamp was switched."""
    return lambda lines: [line["frame"] for line in lines if "lamp" in line] == [frame]


def stands_still(lines: Lines) -> bool:
    return "empty" in [line["status"] for line in lines]


PERIOD = {"codec__key_interval": 2}
#: Of methods that send no residual, so that nothing reads how many passes it gets.
ONE_PASS: dict[str, Any] = {
    "stream__epochs": None,
    "motion__epochs": 1,
    "growth__epochs": 1,
    "growth__gradient": 1e-6,
    "growth__most": 20,
}
RUNS: dict[str, Run] = {
    "s2gs-edge": Run(3),
    "key packets, cut at one": Run(2, settings=PERIOD, shows=keys),
    "key packets, cut after one": Run(3, settings=PERIOD, shows=keys),
    "key packets of still frames, cut at an empty packet": Run(3, source=STILL, settings=PERIOD, shows=stands_still),
    "key packets of still frames, cut at the last": Run(4, source=STILL, settings=PERIOD, shows=stands_still),
    "a pause, cut in the frame that works on": Run(2, source=paused, flags=("--scale", "0.25"), shows=stands_still),
    "a pause, cut at an empty packet": Run(3, source=paused, flags=("--scale", "0.25"), shows=stands_still),
    "a pause, cut after it": Run(4, source=paused, flags=("--scale", "0.25"), shows=stands_still),
    "disturbed, two cameras, one late": Run(
        2, source=f"disturbed:gain_amplitude=0.3,noise_sigma=8,lost_share=0.4,time_offset=test@1:{WORLD}",
        settings={"data__train_views": 2},
    ),
    "trimmed": Run(3, settings={"motion": "still", "codec__trim": 0.4}),
    "scaled images, which bytes do not hold": Run(3, flags=("--scale", "0.5")),
    "a budget of bytes": Run(
        3, flags=("--budget", "size=200B"), shows=lambda lines: any(line["budget"]["binding"] for line in lines[1:])
    ),
    "colours that follow the light, cut before": Run(
        9, source=DIMMING, settings=FOLLOWED, shows=lambda lines: "light_bytes" in lines[10]
    ),
    "colours that follow the light, cut after": Run(
        11, source=DIMMING, settings=FOLLOWED, shows=lambda lines: "light_bytes" in lines[10]
    ),
    "a camera that drifts, cut between two looks": Run(13, source=DRIFTING, settings=FOLLOWED, shows=drifts),
    "a camera that drifts, cut at a look, key packets before it": Run(
        12, source=DRIFTING, settings={**FOLLOWED, "codec__key_interval": 4}, shows=drifts
    ),
    "a lamp, cut at it": Run(7, source=LAMP, settings=FOLLOWED, shows=lit_in(7)),
    "a lamp, cut in the frame after it": Run(8, source=LAMP, settings=FOLLOWED, shows=lit_in(7)),
    "a lamp between two looks, cut after it": Run(9, source=LAMP, settings=FOLLOWED, shows=lit_in(7)),
    "a lamp in the first later frame, cut at a look": Run(
        5, source=LAMP.replace("event=7", "event=1"), settings=FOLLOWED, shows=lit_in(1)
    ),
    "a lamp at a key packet, cut after it": Run(
        9, source=LAMP, settings={**FOLLOWED, "codec__key_interval": 7},
        shows=lambda lines: lit_in(7)(lines) and lines[7]["status"] == "key",
    ),
    "a lamp in a still room, cut after it": Run(
        9, source=LAMP + "&static=1", settings=FOLLOWED, shows=lambda lines: lit_in(7)(lines) and stands_still(lines)
    ),
    "a lamp in a still room, key packets after it": Run(
        11, source=LAMP + "&static=1", settings={**FOLLOWED, "codec__key_interval": 5}, shows=lit_in(7)
    ),
    "a lamp while the first frame is refined": Run(
        3, source=LAMP.replace("event=7", "event=2"),
        settings={**FOLLOWED, "stream__refine_frames": 4, "stream__refine_iterations": 2}, shows=lit_in(2),
    ),
    "growing": Run(4, method="dense", grows=True),
    "growing, with shared gates": Run(4, grows=True),
    "frame 0 of another stream": Run(3, prepare=dense_frame_0),
    "queen with growth": Run(
        3, method="queen", shows=lambda lines: sum(line.get("added_gaussians", 0) for line in lines) > 0,
        settings={
            "streaming_method__growth__every": 1, "streaming_method__growth__grad_threshold": 1e-5,
            "streaming_method__growth__max_added": 30,
            "streaming_method__change__dynamic": 1e-7,
        },
    ),
    "recon with key packets, whose motion remembers anchors": Run(
        3, method="recon", shows=keys,
        settings={**PERIOD, **ONE_PASS, "motion__per_anchor": 8, "motion__measure": "anchor", "motion__step": 0.02},
    ),
    "hicom, refined beside the stream, then a key packet": Run(
        3, method="hicom", settings={**ONE_PASS, "stream__refine_frames": 3, "stream__refine_iterations": 4},
        shows=lambda lines: lines[3]["status"] == "key" and lines[4]["added_gaussians"] > 0,
    ),
    "a residual every second frame, within a budget of bytes": Run(
        3, method="comgs-l", flags=("--budget", "size=200B"), settings={"motion__epochs": 1},
        shows=lambda lines: [line["iterations"] > 0 for line in lines[1:]] == [False, True, False, True],
    ),
    "hold": Run(2, method="hold", settings={"stream__epochs": 20}, shows=stands_still),
}  # fmt: skip
CUTS = ("in a packet", "between packets", "a line lost", "without metrics", "broken off", "not at all")
#: A run that is broken off leaves what "between packets" makes of a whole one: tried for real where more than the
#: scene is carried from frame to frame.
BROKEN_OFF = (
    "s2gs-edge",
    "disturbed, two cameras, one late",
    "a budget of bytes",
    "queen with growth",
    "recon with key packets, whose motion remembers anchors",
)
#: Only budgets read what the log says of the frames before; for the others one cut in a packet stands for all of them,
#: and s2gs-edge goes through every one.
READ_THE_LOG = ("s2gs-edge", "a budget of bytes", "a residual every second frame, within a budget of bytes")
KNOWN = set(load_catalog().names("method"))
CELLS = [
    pytest.param(row, cut, id=f"{row}-{cut}")
    for row, run in RUNS.items()
    for cut in CUTS
    if run.method in KNOWN
    and (row in BROKEN_OFF if cut == "broken off" else row in READ_THE_LOG or cut in ("in a packet", "not at all"))
]


class Whole(NamedTuple):
    """A run to its end, and its command line as options of :func:`encode`."""

    out: Path
    flags: tuple[str, ...]
    options: dict[str, Any]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Whole]:
    """The run of a row, made once for all its cuts."""

    @functools.cache
    def made(row: str) -> Whole:
        run, folder = RUNS[row], tmp_path_factory.mktemp("whole")
        source = run.source if isinstance(run.source, str) else str(run.source(folder / "recording"))
        options = {**SMALL, **run.settings, "source": source, "method": run.method}
        found = Whole(folder / "out", (*run.flags, *run.prepare(folder)), options)
        with pytest.MonkeyPatch.context() as patch:
            if run.grows:
                growing(patch, run.method)
            encode(found.out, *found.flags, **options)
        assert run.shows(metrics(found.out)), "what the row is about did not happen: it proves too little"
        return found

    return made


def cut_short(out: Path, how: str, at: int) -> None:
    """Spoil a finished run so that frame ``at`` is the first that is not whole."""
    stream, log = out / "stream.gss", out / "metrics.jsonl"
    with StreamReader(stream) as reader:
        entry = reader.frames[at]
    size = {"in a packet": entry.offset + 5, "not at all": stream.stat().st_size}.get(how, entry.offset)
    with stream.open("r+b") as file:
        file.truncate(size)
    lines = log.read_text().splitlines(keepends=True)
    if how == "between packets":
        log.write_text("".join(lines[:at]))
    if how == "a line lost":
        log.write_text("".join(lines[: at - 1]) + '{"fra')
    if how == "without metrics":
        log.unlink()


@pytest.mark.parametrize(("row", "cut"), CELLS)
def test_it_resumes_to_the_same_bytes(
    tmp_path: Path, whole: Callable[[str], Whole], row: str, cut: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, out, once = RUNS[row], tmp_path / "out", whole(row)
    if run.grows:
        growing(monkeypatch, run.method)
    if cut == "broken off":
        with broken_off_in(run.at):
            assert run_command(arguments(out, *once.flags, **once.options)) == 130
    else:
        shutil.copytree(once.out, out)
        cut_short(out, cut, run.at)
    log = out / "metrics.jsonl"
    kept = [line for line in log.read_text().splitlines() if line.endswith("}")] if log.exists() else []
    assert encode(out, "--resume", *once.flags, **once.options) == (once.out / "stream.gss").read_bytes()
    lines, undisturbed = metrics(out), metrics(once.out)
    assert [line["frame"] for line in lines] == list(range(len(undisturbed)))
    # Without a log the frames that are there are measured again, and made again where a budget has to learn from them.
    measured = run.at if cut == "without metrics" and "--budget" not in run.flags else 0
    assert ["seconds" in line for line in lines] == [frame >= measured for frame in range(len(lines))]
    # Lines hold seconds: those that are as they were are of frames that were not encoded again.
    same = min(len(kept), run.at if cut != "not at all" else len(undisturbed))
    assert log.read_text().splitlines()[:same] == kept[:same]
    for ours, theirs in zip(lines, undisturbed, strict=True):
        for quantity in ("status", "psnr", "ssim", "psnr_moving", "bytes", "active_gates", "num_gaussians"):
            assert ours.get(quantity) == theirs.get(quantity), quantity
        spent = [json.dumps(line.get("budget", {}).get("usage", {}).get("rd_lambda")) for line in (ours, theirs)]
        assert spent[0] == spent[1]
