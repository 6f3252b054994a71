"""Tiny networks made here: the contract of the part, what it does with their maps, and networks that break theirs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from gsstream_onnx_confidence.estimator import OnnxConfidence

from gsstream.api import InputError, PluginUnavailable, ShapeError
from gsstream.cli.main import run_command
from gsstream.testing.cases import get_case

onnx = pytest.importorskip("onnx")
FOLDER = Path(__file__).parent


def write_network(path: Path, kind: str) -> str:
    """change: min(1, 20 max |difference|); flow: the same times (3, 4) pixels; raw: no probability; one: one input."""
    from onnx import TensorProto, helper, numpy_helper

    def constant(name: str, values: object) -> object:
        return numpy_helper.from_array(np.asarray(values, np.float32), name)

    names = ["previous", "current"][: 1 if kind == "one" else 2]
    inputs = [helper.make_tensor_value_info(n, TensorProto.FLOAT, [1, 3, "H", "W"]) for n in names]
    second = names[-1]
    nodes = [
        helper.make_node("Sub", ["previous", second], ["d"]),
        helper.make_node("Abs", ["d"], ["a"]),
        helper.make_node("Mul", ["a", "gain"], ["g"]),
        helper.make_node("ReduceMax", ["g", "axis"], ["m"], keepdims=1),
        helper.make_node("Min", ["m", "most"], ["c"]),
        helper.make_node("Mul", ["c", "motion"], ["out"]),
    ]
    motion = np.array([3, 4], np.float32).reshape(1, 2, 1, 1) if kind == "flow" else np.ones((1, 1, 1, 1))
    axis = numpy_helper.from_array(np.array([1], np.int64), "axis")
    given = [constant("gain", 20.0), constant("most", 9.0 if kind == "raw" else 1.0), constant("motion", motion), axis]
    output = helper.make_tensor_value_info("out", TensorProto.FLOAT, None)
    graph = helper.make_graph(nodes, kind, inputs, [output], initializer=given)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    onnx.save(model, path)
    return str(path)


@pytest.fixture(scope="session", autouse=True)
def networks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("networks")
    for kind in ("change", "flow", "raw", "one"):
        write_network(folder / f"{kind}.onnx", kind)
    return folder


def part(networks: Path, kind: str, **settings: object) -> OnnxConfidence:
    return OnnxConfidence(OnnxConfidence.Config(path=str(networks / f"{kind}.onnx"), **settings))


@pytest.mark.parametrize("output", ["change", "flow"])
def test_the_contract(networks: Path, output: str) -> None:
    from gsstream.testing.kit import run_checks

    results = run_checks(part(networks, output, output=output))
    assert [result for result in results if not result.ok] == []
    assert sum(result.status == "passed" for result in results) >= 7


def test_what_moved_outranks_what_stood_still(networks: Path) -> None:
    case = get_case("moving")
    z = part(networks, "change").estimate(case)
    assert z[case.moving_mask].mean() > z[~case.moving_mask].mean() + 1


def test_the_map_is_read_where_the_centre_is(networks: Path) -> None:
    case = get_case("one")
    before = tuple(torch.zeros_like(image) for image in case.now)
    now = [torch.zeros_like(image) for image in case.now]
    for view, image in enumerate(now[:2]):  # two of three views see it change, by 0.02: p = (0.4 + 0.4 + 0) / 3
        local = case.cameras.viewmats[view, :3] @ np.append(case.gaussians.means[0].numpy(), 1)
        u, v, _ = (case.cameras.Ks[view] @ local) / local[2]
        image[int(v), int(u)] = 0.02
    z = part(networks, "change").estimate(replace(case, before=before, now=tuple(now)))
    assert float(torch.sigmoid(z)) == pytest.approx(0.8 / 3, rel=1e-5)
    flow = part(networks, "flow", output="flow", pixels=2.0).estimate(replace(case, before=before, now=tuple(now)))
    assert float(torch.sigmoid(flow)) == pytest.approx(2 / 3 * (1 - np.exp(-0.4 * 5 / 2)), rel=1e-5)


@pytest.mark.parametrize(
    ("kind", "output", "error", "message"),
    [
        ("raw", "change", ShapeError, r"expected probabilities in \[0, 1\], got .*last sigmoid"),
        ("change", "flow", ShapeError, r"expected an output float32 \[1, 2, 20, 20\] .* got float32 \[1, 1, 20, 20\]"),
        ("one", "change", InputError, "expected two inputs, previous and current image, got 1"),
        ("nowhere", "change", InputError, r"expected an ONNX file, got path .*confidence\.params\.path=FILE"),
    ],
)
def test_networks_that_break_their_contract_are_refused(
    networks: Path, kind: str, output: str, error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        part(networks, kind, output=output).estimate(get_case("moving"))


def test_a_file_that_is_no_network_is_refused(tmp_path: Path) -> None:
    (tmp_path / "text.onnx").write_text("hello")
    with pytest.raises(InputError, match="expected an ONNX model"):
        OnnxConfidence(OnnxConfidence.Config(path=str(tmp_path / "text.onnx"))).estimate(get_case("moving"))


def test_without_a_file_there_is_no_part(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(PluginUnavailable, match=r"expected the path of an ONNX file, got none; .*params\.path=FILE"):
        OnnxConfidence()
    assert run_command(["check", "onnx"]) == 0
    out = capsys.readouterr().out
    assert "⚠ every check (skipped): confidence 'onnx': expected the path of an ONNX file" in out
    assert out.splitlines()[-1].endswith(" skipped")
    assert "passed" not in out


def test_the_command_checks_a_network_of_ones_own(networks: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = networks / "flow.onnx"
    assert run_command(["check", "confidence/onnx", "--set", f"path={file}", "--set", "output=flow"]) == 0
    assert "✓ confidence_view_order" in capsys.readouterr().out
    assert run_command(["check", "confidence/onnx", "--set", f"path={file}", "--quiet"]) == 1
    assert "expected an output float32 [1, 1, 20, 20]" in capsys.readouterr().out
