"""The output folder: two runs never mix, and nothing unknown is ever deleted."""

from __future__ import annotations

from pathlib import Path

import pytest
from gsstream_lab.gap.measure import GAP_FILES

from gsstream.core.errors import OutputError
from gsstream.engine.run.output import MADE_FILES, RUN_FILES, prepare_output
from gsstream.evaluation import gallery


def test_a_new_folder_is_created(tmp_path: Path) -> None:
    out = tmp_path / "a" / "b"
    assert prepare_output(out) is False
    assert out.is_dir()


def test_a_folder_with_foreign_files_is_fine(tmp_path: Path) -> None:
    for name in ("notes.txt", "video.mp4"):
        (tmp_path / name).write_text("mine")
    assert prepare_output(tmp_path) is False
    assert prepare_output(tmp_path, overwrite=True) is False
    assert {path.read_text() for path in tmp_path.iterdir()} == {"mine"}, "without a run nothing is known to be ours"


@pytest.mark.parametrize("name", RUN_FILES)
def test_any_trace_of_a_run_is_respected(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"x")
    with pytest.raises(OutputError) as caught:
        prepare_output(tmp_path)
    assert f"already holds a run ({name})" in str(caught.value)
    # Only a stream can be continued: advice that the other message takes back sends the user in a circle.
    assert ("--resume" in str(caught.value)) == (name == "stream.gss")
    if name != "stream.gss":
        with pytest.raises(OutputError, match=r"nothing to resume.*--overwrite"):
            prepare_output(tmp_path, resume=True)
    assert "--overwrite" in str(caught.value)
    assert (tmp_path / name).read_bytes() == b"x"


def test_overwrite_deletes_the_files_of_a_run_and_nothing_else(tmp_path: Path) -> None:
    for name in (*RUN_FILES, *MADE_FILES, "notes.txt", "stream.gss.old"):
        (tmp_path / name).write_text(name)
    assert prepare_output(tmp_path, overwrite=True) is False
    assert sorted(path.name for path in tmp_path.iterdir()) == ["notes.txt", "stream.gss.old"]


def test_made_files_are_the_ones_the_gallery_writes() -> None:
    assert set(MADE_FILES) == {gallery.SHEET, gallery.PLOTS, gallery.SUMMARY, gallery.VIDEO, *GAP_FILES}


def test_resume(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match=r"nothing to resume: .* holds no stream\.gss"):
        prepare_output(tmp_path, resume=True)
    (tmp_path / "stream.gss").write_bytes(b"x")
    assert prepare_output(tmp_path, resume=True) is True
    with pytest.raises(OutputError, match="give one of them"):
        prepare_output(tmp_path, resume=True, overwrite=True)
    assert (tmp_path / "stream.gss").read_bytes() == b"x"


def test_a_file_is_no_folder(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("x")
    with pytest.raises(OutputError, match="is a file; expected a folder"):
        prepare_output(tmp_path / "out", overwrite=True)
    with pytest.raises(OutputError, match="cannot be used"):
        prepare_output(tmp_path / "out" / "below")
