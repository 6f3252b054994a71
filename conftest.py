"""Settings of every test of the project and its plugins."""

import gc
import os
import re
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

# Beside other workers a test that spreads over all cores only makes everybody wait, and threads of torch that wait for
# one another keep a core busy. Libraries read these when they are loaded, so that nothing above may import numpy or
# torch. Tests of threads set their numbers themselves.
if "PYTEST_XDIST_WORKER" in os.environ:
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "GSSTREAM_THREADS"):
        os.environ.setdefault(name, "1")


def sees_gpu() -> bool:
    """Return whether torch sees a GPU."""
    import torch

    return torch.cuda.is_available()


# Kernels in Triton are run by its interpreter where torch sees no GPU. Triton reads this when it is imported, which
# torch may do at any time.
if not sees_gpu():
    os.environ.setdefault("TRITON_INTERPRET", "1")

# What pytest collects stays until the end, so Python's collector of garbage begins after it and never goes through it:
# that took a fifth of the processor time of collecting, and a tenth of that of the tests.
gc.disable()

# A submission is tested with the same examples as the one before it; everywhere else new ones are tried each time, and
# what they find becomes an @example.
# No example has a deadline: how long one takes says how busy the machine is.
settings.register_profile("plain", deadline=None)
settings.register_profile("ci", derandomize=True, deadline=None)
settings.load_profile("ci" if os.environ.get("CI") else "plain")

ROOT = Path(__file__).parent
#: Files that take longest, longest first. They are begun first: a long file that is begun last keeps one core busy
#: while the others wait. A name that is missing here costs only time.
LONG = (
    "input/prepare/test_prepare", "input/prepare/test_validate", "flow/test_kills", "flow/test_first_look",
    "flow/test_followed_light", "flow/test_odd_runs", "input/faults/test_faults_and_readers", "flow/test_closed_loop",
    "flow/test_resume", "flow/test_repeat_and_resume", "flow/test_cost_follows_change", "flow/test_budget",
    "flow/test_still_frames", "flow/test_key_refresh", "lab/tests/test_sweep_real",
    "cpu_render/tests/test_cross_aarch64", "contract/test_new_plugin", "contract/test_howtos",
    "discovery/test_six_rings", "lab/tests/test_paper_configs", "web/test_page", "contract/test_saboteurs",
    "contract/test_shipped_plugins", "flow/test_no_overshoot", "web/test_live_page", "web/test_decoder",
    "flow/test_bad_input", "web/test_page_joins", "flow/test_checks", "packet/test_fuzz", "flow/test_run_ends",
    "flow/test_watch", "flow/test_worlds", "lab/tests/test_tune", "queen/tests/test_queen_stream",
    "lab/tests/test_batch", "store/test_run_by_address", "store/test_fetch", "web/test_many_viewers", "tools/test_soak",
    "packet/test_corrupt", "input/seeds/test_depth_maps", "input/recordings/test_layouts", "flow/test_light_process",
    "player/test_player_memory", "evaluation/test_evaluation", "lab/tests/test_compare",
)  # fmt: skip
#: What ``make check`` runs: rooms whose tests are cheap, and the one test of whole runs that must never fail.
QUICK = (
    "core", "recipe", "parts/update", "parts/render", "metrics", "cli", "packet", "packet/lies", "player", "method",
    "discovery", "parts/motion",
)  # fmt: skip
#: Single files of other rooms: budgets, assembling, what is chosen by numbers, the renderer.
QUICK_FILES = (
    "flow/test_closed_loop", "test_architecture", "test_markdown", "test_readme", "contract/test_parts",
    "contract/test_rounding", "cpu_render/tests/test_cpu_contract", "engine/test_budget_pace",
    "engine/test_budget_plan", "engine/test_budget_trim", "engine/test_assemble", "engine/test_candidates",
)  # fmt: skip
#: Too slow for that in these rooms.
NOT_QUICK = (
    "packet/test_fuzz", "packet/test_corrupt", "packet/test_row_edits",
    "packet/test_motion_packets", "player/test_player_memory", "discovery/test_six_rings",
    "discovery/test_broken_plugins", "method/test_whole_method", "recipe/test_recipe_schema",
    "recipe/test_recipe_typos",
)  # fmt: skip


def name_of(path: Path) -> str:
    """Return the name of a test file below ``tests`` or ``plugins``, without its suffix."""
    return Path(os.path.relpath(path, ROOT)).with_suffix("").as_posix().partition("/")[2]


def is_quick(path: Path) -> bool:
    """Return whether ``make check`` runs the tests of a file."""
    name = name_of(path)
    return (name.rpartition("/")[0] in QUICK or name in QUICK_FILES) and name not in NOT_QUICK


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave files unread whose tests ``make check`` would deselect: reading them all takes every worker 20 seconds."""
    wanted = config.option.markexpr.startswith("quick") and collection_path.name.startswith("test_")
    return True if wanted and collection_path.is_file() and not is_quick(collection_path) else None


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Begin with the longest files, mark what ``make check`` runs, and leave out what happens in real time."""
    live = [] if "live" in config.option.markexpr else [item for item in items if item.get_closest_marker("live")]
    if live:
        config.hook.pytest_deselected(items=live)
        items[:] = [item for item in items if item not in set(live)]
    places = {name: place for place, name in enumerate(LONG)}
    for item in items:
        if is_quick(item.path):
            item.add_marker("quick")
    items.sort(key=lambda item: places.get(name_of(item.path), len(LONG)))


def pytest_collection_finish() -> None:
    """Hand the tests over to memory that is never searched, and begin to collect garbage."""
    gc.freeze()
    gc.enable()


def pytest_unconfigure() -> None:
    """Take the tests back, so that the interpreter ends without leaks."""
    gc.unfreeze()


#: How a reason for skipping names what is missing: "... (apt install nodejs)".
REMEDY = re.compile(r"\((apt|npm) install ([^)]+)\)")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Add the limit that continuous integration sets."""
    about = "fail when more tests than this are skipped"
    parser.addoption("--most-skipped", type=int, default=None, metavar="N", help=about)


def skip_reasons(reporter: Any) -> Counter[str]:
    """Count the reasons for which tests were skipped."""
    reports = reporter.stats.get("skipped", [])
    reasons = (r.longrepr[2] if isinstance(r.longrepr, tuple) else str(r.longrepr) for r in reports)
    return Counter(reason.removeprefix("Skipped: ") for reason in reasons)


@pytest.hookimpl(tryfirst=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """Fail a session of which more was skipped than may be; a worker has no reporter and decides nothing."""
    reporter, most = session.config.pluginmanager.get_plugin("terminalreporter"), session.config.option.most_skipped
    too_many = most is not None and reporter is not None and skip_reasons(reporter).total() > most
    if too_many and session.exitstatus == pytest.ExitCode.OK:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter: Any, config: pytest.Config) -> None:
    """Say what was not run, and why: a skipped test is a hole, and nobody sees it among thousands of dots."""
    reasons = skip_reasons(terminalreporter)
    if not reasons:
        return
    terminalreporter.section("not run here, and why")
    for reason, count in sorted(reasons.items(), key=lambda pair: (-pair[1], pair[0])):
        terminalreporter.write_line(f"{count:5d}  {reason}")
    missing: dict[str, dict[str, None]] = {}
    for tool, names in (match for reason in reasons for match in REMEDY.findall(reason)):
        missing.setdefault(tool, {}).update(dict.fromkeys(names.split()))
    if missing:
        commands = "; ".join(f"{tool} install {' '.join(names)}" for tool, names in missing.items())
        terminalreporter.write_line(f"To run the rest: {commands}")
    most = config.option.most_skipped
    if most is not None and reasons.total() > most:
        terminalreporter.write_line(f"FAILED: {reasons.total()} tests were skipped; at most {most} may be")
