"""PLYs of 3D Gaussian splatting: ours come back as they were written, those of others are read or refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

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
        (lambda data: b"solid x", "expected a PLY with the line"),
        (lambda data: data[:-1], "bytes of vertices"),
        (lambda data: data.replace(b"float opacity", b"float opaque!"), "missing opacity"),
        (lambda data: data.replace(b"vertex 7", b"vertex x"), "header is not that of a 3DGS PLY"),
        (lambda data: data.replace(b"vertex 7", b"vertex -1"), "header is not that of a 3DGS PLY"),
        (lambda data: data.replace(b"property float x", b"property list x"), "header is not that of a 3DGS PLY"),
        (lambda data: data.replace(b"property float y", b"property float x"), "each property once"),
    ],
)
def test_files_that_are_no_such_ply_are_refused(tmp_path: Path, change, said: str) -> None:
    path = tmp_path / "a.ply"
    path.write_bytes(change(ply_bytes(make_scene(7, 1))))
    with pytest.raises(InputError, match=said):
        read_ply(path)
