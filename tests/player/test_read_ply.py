"""PLYs of 3D Gaussian splatting: ours come back as they were written, those of others are read or refused."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gsstream.core.errors import InputError
from gsstream.player.ply import ply_bytes, read_ply
from tests.scenes import make_scene


@pytest.mark.parametrize(("number", "rest"), [(7, 0), (7, 3), (7, 8), (7, 15), (0, 3), (1, 0)])
def test_a_ply_is_read_as_it_was_written(tmp_path: Path, number: int, rest: int) -> None:
    written, path = make_scene(number, rest + 1), tmp_path / "a.ply"
    path.write_bytes(ply_bytes(written, ["offset 1.5 -2 1e6"]))
    read, offset = read_ply(path)
    assert offset == (1.5, -2.0, 1e6)
    for (name, value), (_, expected) in zip(read.items(), written.items(), strict=True):
        assert value.tobytes() == expected.tobytes(), name


def test_properties_in_another_order_and_of_other_types_are_read(tmp_path: Path) -> None:
    """As other programs write them: a property more, doubles, and no normals."""
    written = make_scene(3, 1)
    columns = {
        "red": np.zeros(3, np.uint8),
        "opacity": written.opacities.astype("<f8"),
        **{f"rot_{i}": written.quats[:, i] for i in range(4)},
        **{f"scale_{i}": written.scales[:, i] for i in range(3)},
        **{f"f_dc_{i}": written.sh0[:, 0, i] for i in range(3)},
        **{name: written.means[:, i] for i, name in enumerate("zyx")},
    }
    kinds = {"|u1": "uchar", "<f8": "double", "<f4": "float"}
    head = ["ply", "format binary_little_endian 1.0", "element vertex 3"]
    head += [f"property {kinds[value.dtype.str]} {name}" for name, value in columns.items()]
    table = np.zeros(3, [(name, value.dtype) for name, value in columns.items()])
    for name, value in columns.items():
        table[name] = value
    (tmp_path / "a.ply").write_bytes("\n".join([*head, "end_header\n"]).encode() + table.tobytes())
    read, offset = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(read.means, written.means[:, ::-1])
    np.testing.assert_array_equal(read.opacities, written.opacities)
    assert offset == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda data: b"solid x", "not a PLY file"),
        (lambda data: data[:-1], "bytes of vertices"),
        (lambda data: data.replace(b"float opacity", b"float opaque!"), "missing opacity"),
        (lambda data: data.replace(b"vertex 7", b"vertex x"), "has the line 'element vertex x'"),
        (lambda data: data.replace(b"vertex 7", b"vertex -1"), "expected a name and a count"),
        (lambda data: data.replace(b"property float x", b"property list x"), "is not a plain number"),
        (lambda data: data.replace(b"property float y", b"property float x"), "is there twice"),
    ],
)
def test_files_that_are_no_such_ply_are_refused(tmp_path: Path, change, said: str) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(change(ply_bytes(make_scene(7, 1))))
    with pytest.raises(InputError, match=said):
        read_ply(path)


def written_as(head: str, body: bytes) -> bytes:
    return head.encode() + b"end_header\n" + body


def parts(number: int = 7) -> tuple[str, bytes]:
    head, _, body = ply_bytes(make_scene(number, 4)).partition(b"end_header\n")
    return head.decode(), body


def as_text(head: str, body: bytes) -> bytes:
    rows = np.frombuffer(body, "<f4").reshape(7, -1)
    text = "\n".join(" ".join(repr(float(value)) for value in row) for row in rows) + "\n"
    return written_as(head.replace("binary_little_endian", "ascii"), text.encode())


FACES = "element face 2\nproperty list uchar int vertex_indices\n"
VARIANTS = {
    "CRLF": lambda head, body: head.replace("\n", "\r\n").encode() + b"end_header\r\n" + body,
    "no faces": lambda head, body: written_as(head + FACES.replace("2", "0"), body),
    "faces behind": lambda head, body: written_as(head + FACES, body + bytes([3, *range(12)] * 2)),
    "an element before": lambda head, body: written_as(
        head.replace("element vertex", "element extra 3\nproperty int a\nproperty uchar b\nelement vertex"),
        bytes(15) + body,
    ),
    "lists before, none of them": lambda head, body: written_as(
        head.replace("element vertex", FACES.replace("2", "0") + "element vertex"), body
    ),
    "text": as_text,
    "text, faces before": lambda head, body: as_text(
        head.replace("element vertex", FACES + "element vertex"), body
    ).replace(b"end_header\n", b"end_header\n3 0 1 2\n3 0 1 2\n"),
    "comments": lambda head, body: written_as(head.replace("\n", "\nobj_info 1\ncomment offset_of 3\n", 1), body),
}  # fmt: skip


@pytest.mark.parametrize("name", VARIANTS)
def test_headers_of_other_programs_are_read(tmp_path: Path, name: str) -> None:
    head, body = parts()
    (tmp_path / "ours.ply").write_bytes(written_as(head, body))
    (tmp_path / "theirs.ply").write_bytes(VARIANTS[name](head, body))
    ours, theirs = read_ply(tmp_path / "ours.ply")[0], read_ply(tmp_path / "theirs.ply")[0]
    for (field, value), (_, expected) in zip(theirs.items(), ours.items(), strict=True):
        assert value.tobytes() == expected.tobytes(), field


def spoiled(path: Path, name: str, row: int, value: float) -> Path:
    head, body = parts()
    names = [line.split()[2] for line in head.splitlines() if line.startswith("property")]
    table = np.frombuffer(body, "<f4").reshape(7, -1).copy()
    table[row, names.index(name)] = value
    path.write_bytes(written_as(head, table.tobytes()))
    return path


def test_an_opacity_of_one_is_read_as_viewers_draw_it_and_said(tmp_path: Path) -> None:
    for value in (np.inf, -np.inf):
        path = spoiled(tmp_path / "a.ply", "opacity", 4, value)
        with pytest.warns(UserWarning, match=r"a\.ply: 1 opacities are infinite"):
            read, _ = read_ply(path)
        assert read.opacities[4] == np.sign(value) * 20
        assert 1 / (1 + np.exp(-np.float64(abs(read.opacities[4])))) > 1 - 1e-8
        assert np.array_equal(np.delete(read.opacities, 4), np.delete(make_scene(7, 4).opacities, 4))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", ["x", "f_dc_1", "f_rest_2", "opacity", "scale_2", "rot_0"])
def test_a_value_that_is_not_finite_is_named_with_file_and_row(tmp_path: Path, name: str, value: float) -> None:
    path = spoiled(tmp_path / "a.ply", name, 5, value)
    if name == "opacity" and np.isinf(value):
        return
    with pytest.raises(InputError, match=r"a\.ply: vertex 5: \w+ are .*expected finite values.*1 such"):
        read_ply(path)


def test_a_rotation_of_zeros_is_named(tmp_path: Path) -> None:
    head, body = parts()
    table = np.frombuffer(body, "<f4").reshape(7, -1).copy()
    table[2, -4:] = 0
    (tmp_path / "a.ply").write_bytes(written_as(head, table.tobytes()))
    with pytest.raises(InputError, match=r"a\.ply: vertex 2: quats are .*not all zero"):
        read_ply(tmp_path / "a.ply")


@given(st.data())
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_any_damage_is_refused_or_read_as_finite(tmp_path: Path, data: st.DataObject) -> None:
    """Bytes of the header overwritten: counts, types and names of every kind."""
    head, body = parts()
    damaged = bytearray(written_as(head, body))
    for _ in range(data.draw(st.integers(1, 3))):
        damaged[data.draw(st.integers(0, len(head) - 1))] = data.draw(st.sampled_from(b"0179 -\nxefp."))
    path = tmp_path / "a.ply"
    path.write_bytes(bytes(damaged))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            read, _ = read_ply(path)
        except InputError:
            return
    assert all(np.isfinite(value).all() for _, value in read.items())
