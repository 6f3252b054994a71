"""LPIPS by a file of the user: tiny ONNX models whose answer is known, and every way such a file can be wrong."""

from __future__ import annotations

import json
import re
import sys

import numpy as np
import pytest
from evaluation.test_evaluation import NUMPY, Rendered, make_stream

from gsstream.cli.main import run_command
from gsstream.core.errors import InputError, ShapeError
from gsstream.evaluation.evaluate import evaluate
from gsstream.metrics import OnnxLpips

onnx = pytest.importorskip("onnx", reason="onnx writes the models of these tests")
pytest.importorskip("onnxruntime", reason="onnxruntime runs the models of these tests")

IMAGE = (1, 3, "height", "width")
FLOAT = onnx.TensorProto.FLOAT


def save(
    path,
    *,
    range_from=None,
    inputs=(("x", IMAGE, FLOAT), ("y", IMAGE, FLOAT)),
    outputs=(("d", (1, 1, 1, 1)),),
    nodes=(("Sub", "xy", "e"), ("Abs", "e", "a"), ("ReduceMean", "a", "d")),
):
    """By default the mean absolute difference, as [1, 1, 1, 1]."""
    helper = onnx.helper
    given = [helper.make_tensor_value_info(name, kind, shape) for name, shape, kind in inputs]
    made = [helper.make_tensor_value_info(name, FLOAT, shape) for name, shape in outputs]
    graph = helper.make_graph([helper.make_node(op, list(a), [b]) for op, a, b in nodes], "distance", given, made)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9)
    if range_from is not None:
        helper.set_model_props(model, {"gsstream.lpips.range": range_from})
    onnx.save(model, path)
    return path


def pair(height=19, width=23):
    return np.random.default_rng(5).random((2, height, width, 3))


@pytest.mark.parametrize(("range_from", "scale"), [("-1", 2), ("0", 1)])
@pytest.mark.parametrize("by_option", [True, False])
def test_the_distance_is_the_models_in_either_range(tmp_path, range_from, scale, by_option):
    file = save(tmp_path / "mad.onnx", range_from=None if by_option else range_from)
    metric = OnnxLpips(file, range_from if by_option else None)
    image, target = pair()
    assert metric(image, target) == pytest.approx(scale * np.abs(image - target).mean(), rel=1e-5)
    assert metric(image, image) == 0
    assert metric(image[:7], target[:7]) == pytest.approx(scale * np.abs(image - target)[:7].mean(), rel=1e-5)
    assert metric.variant.startswith("LPIPS of mad.onnx, inputs in [" + range_from)


@pytest.mark.parametrize(("range_from", "expected"), [("-1", lambda x: 2 * x - 1), ("0", lambda x: x)])
def test_the_model_sees_planes_in_the_range_it_is_promised(tmp_path, range_from, expected):
    """The answer is the very first value of the first or the second input: no swap, no offset, channels first."""
    image, target = pair()
    image[0, 0], target[0, 0] = (0.25, 0.5, 0.75), (0.875, 0, 0)
    for name, value in (("x", image), ("y", target)):
        for channel in range(3):
            first = [onnx.numpy_helper.from_array(np.int64(v), n) for n, v in _cut(channel)]
            file = save(tmp_path / f"{name}{channel}.onnx", nodes=[("Slice", [name, *"seo"], "d")])
            model = onnx.load(file)
            model.graph.initializer.extend(first)
            onnx.save(model, file)
            got = OnnxLpips(file, range_from)(image, target)
            assert got == pytest.approx(expected(value[0, 0, channel]), abs=1e-6)


def _cut(channel):
    """Start, end and axes of a slice that leaves one value of one channel."""
    return [("s", [channel, 0, 0]), ("e", [channel + 1, 1, 1]), ("o", [1, 2, 3])]


def test_the_option_wins_over_the_metadata(tmp_path):
    file = save(tmp_path / "mad.onnx", range_from="-1")
    image, target = pair()
    assert OnnxLpips(file)(image, target) == pytest.approx(2 * OnnxLpips(file, "0")(image, target), rel=1e-5)
    assert "3dgs" in OnnxLpips(file, "0").variant


FAULTS = {
    "one input": (
        {"inputs": [("x", IMAGE, FLOAT)], "nodes": [("ReduceMean", "x", "d")]},
        "expected a model of two inputs, image and target, got 1 ('x')",
    ),
    "three inputs": (
        {"inputs": [(name, IMAGE, FLOAT) for name in "xyz"]},
        "expected a model of two inputs, image and target, got 3 ('x', 'y', 'z')",
    ),
    "one channel": (
        {"inputs": [(name, (1, 1, "h", "w"), FLOAT) for name in "xy"]},
        "expected input 'x' to be float32 [1, 3, H, W], got tensor(float) [1, 1, 'h', 'w']",
    ),
    "no batch": (
        {"inputs": [(name, (3, "h", "w"), FLOAT) for name in "xy"], "outputs": [("d", (1, 1, 1))]},
        "expected input 'x' to be float32 [1, 3, H, W], got tensor(float) [3, 'h', 'w']",
    ),
    "two outputs": (
        {"outputs": [("d", (1, 1, 1, 1)), ("a", IMAGE)]},
        "expected a model of one output, the distance, got 2",
    ),
    "a map": (
        {"outputs": [("a", (1, 3, 19, 23))]},
        "expected output 'a' to be one float32 number, got tensor(float) [1, 3, 19, 23]; export the mean",
    ),
}


@pytest.mark.parametrize("name", FAULTS)
def test_a_model_of_another_shape_is_refused_when_opened(tmp_path, name):
    changes, message = FAULTS[name]
    file = save(tmp_path / "odd.onnx", range_from="0", **changes)
    with pytest.raises(InputError, match=re.escape(f"{file}: {message}")):
        OnnxLpips(file)


def test_a_model_of_doubles_is_refused(tmp_path):
    inputs = [(name, IMAGE, onnx.TensorProto.DOUBLE) for name in "xy"]
    file = save(tmp_path / "double.onnx", inputs=inputs, outputs=[("s", (4,))], nodes=[("Shape", "x", "s")])
    model = onnx.load(file)
    model.graph.output[0].type.tensor_type.elem_type = onnx.TensorProto.INT64
    onnx.save(model, file)
    with pytest.raises(InputError, match=r"expected input 'x' to be float32 .* got tensor\(double\)"):
        OnnxLpips(file, "0")


def test_an_output_that_turns_out_to_be_a_map_is_refused(tmp_path):
    shape = (1, "channels", "height", "width")  # all lengths dynamic, so that it shows only when it runs
    file = save(tmp_path / "map.onnx", inputs=[(name, shape, FLOAT) for name in "xy"], outputs=[("a", shape)])
    message = r"map.onnx: expected one number for a pair of images, got an output of shape \[1, 3, 19, 23\] for"
    with pytest.raises(ShapeError, match=message):
        OnnxLpips(file, "0")(*pair())


def test_an_answer_that_is_not_finite_is_refused(tmp_path):
    nodes = [("Sub", "xy", "e"), ("Div", "ee", "q"), ("ReduceMean", "q", "d")]
    metric = OnnxLpips(save(tmp_path / "div.onnx", nodes=nodes), "0")
    image, target = pair()
    assert metric(image, target) == pytest.approx(1)
    with pytest.raises(InputError, match=r"div.onnx: expected a finite distance, got nan for images of 23 x 19"):
        metric(image, image)


def test_a_model_of_another_size_is_refused_when_asked(tmp_path):
    file = save(tmp_path / "fixed.onnx", inputs=[(name, (1, 3, 19, 23), FLOAT) for name in "xy"])
    metric = OnnxLpips(file, "0")
    assert metric(*pair()) > 0
    with pytest.raises(InputError, match=r"fixed.onnx: the model failed on images of 20 x 10: .*dynamic height"):
        metric(*pair(10, 20))
    with pytest.raises(ShapeError, match="two \\[H, W, 3\\] images"):
        metric(pair()[0], pair(10, 20)[0])


def test_a_file_that_is_no_model_is_refused(tmp_path):
    file = tmp_path / "bad.onnx"
    with pytest.raises(InputError, match=rf"no ONNX file at {re.escape(str(file))}"):
        OnnxLpips(file)
    whole = save(tmp_path / "good.onnx").read_bytes()
    for content in (b"", b"not a model", whole[: len(whole) // 2]):
        file.write_bytes(content)
        with pytest.raises(InputError, match=rf"{re.escape(str(file))}: expected an ONNX model"):
            OnnxLpips(file, "0")


def test_a_range_that_is_unknown_or_missing_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"mad.onnx does not say which range .* -1 .* or 0 "):
        OnnxLpips(save(tmp_path / "mad.onnx"))
    with pytest.raises(InputError, match="got '1' from the option"):
        OnnxLpips(tmp_path / "mad.onnx", "1")
    with pytest.raises(InputError, match=r"got '\[0,1\]' from its metadata key gsstream.lpips.range"):
        OnnxLpips(save(tmp_path / "odd.onnx", range_from="[0,1]"))


def test_without_onnxruntime_the_message_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(InputError, match=re.escape("pip install 'gsstream[onnx]'")):
        OnnxLpips(save(tmp_path / "mad.onnx"), "0")


def test_evaluation_has_lpips_only_when_it_was_measured(tmp_path):
    stream = make_stream(tmp_path / "s.gss")
    plain = evaluate(stream, Rendered(stream, noise=0.02), renderer=NUMPY)
    assert "lpips" not in (plain.table() + plain.to_json()).lower()
    metric = OnnxLpips(save(tmp_path / "mad.onnx"), "-1")
    measured = evaluate(stream, Rendered(stream, noise=0.02), renderer=NUMPY, lpips=metric)
    head, _, decoded, held, _, notes = measured.table().splitlines()
    assert head.split("|")[-2].strip() == "LPIPS"
    assert metric.variant in notes
    assert f"{np.mean([v.lpips for v in measured.views if v.frame]):.4f}" == decoded.split("|")[-2].strip()
    assert f"{np.mean([v.static_lpips for v in measured.views if v.frame]):.4f}" == held.split("|")[-2].strip()
    for view in measured.views:
        moved = view.frame > 0
        assert (view.static_lpips > view.lpips > 0) if moved else (view.static_lpips == view.lpips)
    data = json.loads(measured.to_json())
    assert data["lpips_variant"] == metric.variant
    assert [v["lpips"] for v in data["views"]] == [v.lpips for v in measured.views]


@pytest.fixture(scope="module")
def small_run(tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "small"
    source = "synthetic:frames=2&views=2&width=40&height=30"
    tiny = ["--set", "first_frame.max_iterations=2", "--set", "first_frame.points=recording"]
    run = ["run", "--source", source, "--out", str(out), "--method", "dense", *tiny, "--quiet", "--no-pictures"]
    assert run_command(run) == 0
    return out


def test_the_command_measures_lpips_when_asked(tmp_path, capsys, small_run):
    file = str(save(tmp_path / "mad.onnx", range_from="-1"))
    assert run_command(["evaluate", str(small_run)]) == 0
    assert "LPIPS" not in capsys.readouterr().out
    distances = []
    for options in ([], ["--lpips-range", "0"]):
        assert run_command(["evaluate", str(small_run), "--lpips-onnx", file, *options]) == 0
        table = capsys.readouterr().out
        assert "LPIPS of mad.onnx, inputs in [" + ("0, 1] (3dgs" if options else "-1, 1] (lpips") in table
        distances.append(float(table.splitlines()[2].split("|")[-2]))
    assert distances[0] == pytest.approx(2 * distances[1], abs=2e-4)
    assert run_command(["evaluate", str(small_run), "--lpips-onnx", file, "--lpips-range", "-1"]) == 0


def test_the_command_refuses_a_range_without_a_file(capsys, small_run):
    assert run_command(["evaluate", str(small_run), "--lpips-range", "0"]) == 2
    assert "without --lpips-onnx" in capsys.readouterr().err
