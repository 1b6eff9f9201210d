"""Stereo networks in files: tiny models with the public exports' signatures, against NumPy and plain functions."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir

from torchfovea.cli import main
from torchfovea.commands.shared.build import build_match
from torchfovea.commands.shared.config import conf_dir
from torchfovea.sensing.camera import Pinhole
from torchfovea.sensing.layout import LogPolar
from torchfovea.setting import SettingError
from torchfovea.stereo.external import External, match_external
from torchfovea.stereo.onnx_model import OnnxModel
from torchfovea.stereo.views import rectified_views

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")
from onnx import TensorProto, helper, numpy_helper  # noqa: E402

SIZE = (64, 96)


def write(path, inputs, nodes, outputs, constants=()):
    """A model of inputs and outputs (name, type, shape) with nodes (op, inputs, outputs, attributes)."""
    graph = helper.make_graph(
        [helper.make_node(op, list(i), list(o), **a) for op, i, o, a in nodes],
        "tiny",
        [helper.make_tensor_value_info(*one) for one in inputs],
        [helper.make_tensor_value_info(*one) for one in outputs],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in constants],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.checker.check_model(model)
    onnx.save(model, path)
    return str(path)


def images(size=SIZE, seed=0):
    rng = np.random.default_rng(seed)
    return rng.random((*size, 3), np.float32), rng.random((*size, 3), np.float32)


def red(name, to, dtype=TensorProto.FLOAT):
    """Nodes that take the red channel of an input as floats."""
    return [
        ("Cast", [name], [f"{name}_float"], {"to": TensorProto.FLOAT}),
        ("Gather", [f"{name}_float", "zero"], [to], {"axis": 1}),
    ]


ZERO = ("zero", np.array([0], np.int64))


def s2m2(path, size=SIZE):
    """Bytes in; disparity = left's red less right's, occlusion, and the left's red/255 as confidence."""
    shape = [1, 3, *size]
    return write(
        path,
        [("input_left", TensorProto.UINT8, shape), ("input_right", TensorProto.UINT8, shape)],
        [
            *red("input_left", "l"), *red("input_right", "r"), ("Sub", ["l", "r"], ["output_disp"], {}),
            ("Mul", ["l", "none"], ["output_occ"], {}), ("Mul", ["l", "byte"], ["output_conf"], {}),
        ],
        [(f"output_{name}", TensorProto.FLOAT, [1, 1, *size]) for name in ("disp", "occ", "conf")],
        [ZERO, ("none", np.float32(0)), ("byte", np.float32(1 / 255))],
    )  # fmt: skip


def two_to_one(path, names=("left", "right"), out="disp", dtype=TensorProto.FLOAT, extra=()):
    """Disparity = left's red less right's, at the inputs' size, whose symbols each exporter names as it likes."""
    return write(
        path,
        [*((name, dtype, ["b", 3, f"height_{name}", f"width_{name}"]) for name in names), *extra],
        [*red(names[0], "l"), *red(names[1], "r"), ("Sub", ["l", "r"], [out], {})],
        [(out, TensorProto.FLOAT, ["b", 1, "height", "width"])],
        [ZERO],
    )


def raft(path):
    """A flow at a quarter of the size and one at full size, right's red less left's."""
    shape = [1, 3, *SIZE]
    return write(
        path,
        [("left", TensorProto.FLOAT, shape), ("right", TensorProto.FLOAT, shape)],
        [
            *red("left", "l"), *red("right", "r"), ("Sub", ["r", "l"], ["upscaled_disparity"], {}),
            ("AveragePool", ["upscaled_disparity"], ["disparity"], {"kernel_shape": [4, 4], "strides": [4, 4]}),
        ],
        [
            ("disparity", TensorProto.FLOAT, [1, 1, SIZE[0] // 4, SIZE[1] // 4]),
            ("upscaled_disparity", TensorProto.FLOAT, [1, 1, *SIZE]),
        ],
        [ZERO],
    )  # fmt: skip


def stacked(path, axis):
    """One input with both images; (2, 3, H, W) or (1, 6, H, W)."""
    shape = [2, 3, *SIZE] if axis == 0 else [1, 6, *SIZE]
    return write(
        path,
        [("images", TensorProto.FLOAT, shape)],
        [
            ("Split", ["images"], ["one", "two"], {"axis": axis}),
            *red("one", "l"), *red("two", "r"), ("Sub", ["l", "r"], ["disparity"], {}),
        ],
        [("disparity", TensorProto.FLOAT, [1, 1, *SIZE])],
        [ZERO],
    )  # fmt: skip


def constant(path, disparity, worth=None):
    """A model that answers the same whatever it sees."""
    shape = [1, 3, *disparity.shape]
    maps = {"disparity": disparity} | ({} if worth is None else {"worth": worth})
    nodes = [("ReduceSum", ["left", "axes"], ["seen"], {"keepdims": 1}), ("Mul", ["seen", "none"], ["zeros"], {})]
    nodes += [("Add", ["zeros", f"{name}_map"], [name], {}) for name in maps]
    return write(
        path,
        [("left", TensorProto.FLOAT, shape), ("right", TensorProto.FLOAT, shape)],
        nodes,
        [(name, TensorProto.FLOAT, [1, 1, *disparity.shape]) for name in maps],
        [
            ("axes", np.array([1], np.int64)),
            ("none", np.float32(0)),
            *((f"{name}_map", value.astype(np.float32)[None, None]) for name, value in maps.items()),
        ],
    )


def test_the_networks_get_their_images_and_give_disparities(tmp_path):
    """What reaches the network is peak · image, less the mean, over the deviation, in its own type."""
    left, right = images()
    difference = 255 * (left - right)[..., 0]
    whole = np.round(255 * left[..., 0]) - np.round(255 * right[..., 0])
    disparity, confidence = OnnxModel(
        s2m2(tmp_path / "s2m2.onnx"), "input_left", "input_right", "output_disp", "output_conf"
    )(left, right)
    np.testing.assert_array_equal(disparity.numpy(), whole)
    np.testing.assert_allclose(confidence.numpy(), np.round(255 * left[..., 0]) / 255, atol=1e-6)
    for model in (
        OnnxModel(two_to_one(tmp_path / "foundation.onnx"), "left", "right", "disp"),
        OnnxModel(two_to_one(tmp_path / "double.onnx", dtype=TensorProto.DOUBLE)),
        OnnxModel(stacked(tmp_path / "batch.onnx", 0)),
        OnnxModel(stacked(tmp_path / "channels.onnx", 1)),
    ):
        np.testing.assert_allclose(model(left, right).numpy(), difference, atol=2e-5)
    half = OnnxModel(two_to_one(tmp_path / "half.onnx", dtype=TensorProto.FLOAT16))
    np.testing.assert_allclose(half(left, right).numpy(), difference, atol=0.13)  # 255 in half precision
    flow = OnnxModel(raft(tmp_path / "raft.onnx"), disparity="upscaled_disparity")
    np.testing.assert_allclose(-flow(left, right).numpy(), difference, atol=2e-5)
    scaled = OnnxModel(two_to_one(tmp_path / "n.onnx"), peak=1.0, mean=[0.4, 0.5, 0.6], std=[0.2, 0.3, 0.4])
    np.testing.assert_allclose(scaled(left, right).numpy(), (left - right)[..., 0] / 0.2, atol=1e-6)
    swapped = OnnxModel(two_to_one(tmp_path / "s.onnx", names=("b", "a")), left="a", right="b")
    np.testing.assert_allclose(swapped(left, right).numpy(), -difference, atol=2e-5)
    # one name tells the other
    for settings in (dict(left="a"), dict(right="b")):
        np.testing.assert_allclose(
            OnnxModel(tmp_path / "s.onnx", **settings)(left, right).numpy(), -difference, atol=2e-5
        )


@pytest.mark.parametrize("size", [(50, 70), (64, 96), (33, 96)])
def test_smaller_images_are_padded_and_cut_out_again(tmp_path, size):
    left, right = images(size)
    expected = 255 * (left - right)[..., 0]
    fixed, free = s2m2(tmp_path / "fixed.onnx"), two_to_one(tmp_path / "free.onnx")
    model = OnnxModel(fixed, "input_left", "input_right", "output_disp")
    np.testing.assert_allclose(model(left, right).numpy(), expected, atol=1)
    np.testing.assert_allclose(OnnxModel(free)(left, right).numpy(), expected, atol=2e-5)
    np.testing.assert_allclose(OnnxModel(free, size_px=[64, 128])(left, right).numpy(), expected, atol=2e-5)


@pytest.mark.parametrize(("tells", "power"), [("confidence", 0), ("sigma", 1), ("variance", 2)])
def test_larger_images_are_shrunk_and_disparities_grow_again(tmp_path, tells, power):
    """A ramp and a step at half the size: twice the disparity, and nothing between the two surfaces."""
    row, column = np.mgrid[: SIZE[0], : SIZE[1]]
    small = np.where(column < 48, 2 + 0.05 * row, 20.0)
    worth = np.where(column < 48, 0.25, 0.75)
    model = OnnxModel(constant(tmp_path / "m.onnx", small, worth), worth="worth", tells=tells)
    large, told = (one.numpy() for one in model(*images((128, 192))))
    row, column = np.mgrid[:128, :192]
    expected = np.where(column < 96, 2 * (2 + 0.05 * np.clip((row + 0.5) / 2 - 0.5, 0, 63)), 40)
    np.testing.assert_allclose(large, expected, atol=1e-4)
    np.testing.assert_allclose(told, 2**power * np.where(column < 96, 0.25, 0.75))


def test_it_is_a_matcher(tmp_path):
    """The same correspondences as from a function that returns the same disparity."""
    disparity = 6 + 0.05 * np.mgrid[: SIZE[0], : SIZE[1]][1]
    confidence = np.tile(np.linspace(0, 1, SIZE[1]), (SIZE[0], 1))
    model = OnnxModel(constant(tmp_path / "m.onnx", disparity, confidence), worth="worth")
    left, right = (torch.from_numpy(image).movedim(-1, 0) for image in images())
    views = rectified_views(left, right, Pinhole(120.0, 50.0, 32.0), Pinhole(120.0, 55.0, 32.0), 0.2)
    params = External(least_confidence=0.2)
    retina = LogPolar(500)
    found, _ = match_external(model, views, retina, params, nearest_range_m=0.5)
    expected, _ = match_external(lambda *pair: (disparity, confidence), views, retina, params, nearest_range_m=0.5)
    assert found.valid.sum() > 300
    for mine, other in zip(found, expected, strict=True):
        torch.testing.assert_close(mine, other)


PRESETS = {
    "onnx": (two_to_one, 1.0),
    "onnx_s2m2": (s2m2, 1.0),
    "onnx_foundation_stereo": (two_to_one, 1.0),
    "onnx_raft_stereo": (raft, -1.0),
    "onnx_igev": (lambda path: stacked(path, 0), 1.0),
}


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_fit_the_public_exports(tmp_path, preset):
    make, sign = PRESETS[preset]
    path = make(tmp_path / "model.onnx")
    with initialize_config_dir(conf_dir(), version_base="1.3"):
        cfg = compose("sense", [f"matcher={preset}", f"matcher.model={path}"])
    matcher = build_match(cfg)
    left, right = images()
    answer = matcher.source(left, right)
    told = isinstance(answer, tuple)
    assert told == (preset == "onnx_s2m2") and matcher.params.scale == sign
    disparity = (answer[0] if told else answer).numpy()
    np.testing.assert_allclose(sign * disparity, 255 * (left - right)[..., 0], atol=1 if told else 2e-5)


def test_a_confidence_that_is_turned_round_is_told(tmp_path, capsys, monkeypatch):
    """Errors that grow with the confidence; the fit finds that what it claims is worth nothing."""
    true = pytest.importorskip("skimage.data").stereo_motorcycle()[2]
    rng = np.random.default_rng(0)
    worth = rng.random(true.shape)
    path = constant(
        tmp_path / "m.onnx", np.where(np.isfinite(true), true, 0) + 2 * worth * rng.standard_normal(true.shape), worth
    )
    monkeypatch.chdir(tmp_path)
    network = f"matcher.model={path}", "matcher.source.worth=worth", "matcher.nearest_range_m=1.5"
    assert main(["calibrate", "matcher=onnx", *network, "scenes=0", "real=true", "sensor.receptive_fields=3000"]) == 0
    said = capsys.readouterr()
    assert "matcher.tells = confidence: errors shrink where it claims that they grow" in said.err
    assert "matcher.tells=doubt turns it round" in said.err
    result = json.loads((Path(said.out.splitlines()[-1]) / "result.json").read_text())
    assert result["claim_rank_correlation"] < -0.2 and result["fit.claim"] < 0.3


def test_a_missing_model_stops_a_command_in_one_line(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    for override, line in (
        ("matcher.model=none.onnx", "matcher.model = none.onnx: expected an existing ONNX file"),
        ("matcher.source.left=x", "matcher.model = None: expected an ONNX file: matcher.model=FILE"),
    ):
        assert main(["sense", "pair=motorcycle", "matcher=onnx", override]) == 1
        assert capsys.readouterr().err.splitlines() == [f"torchfovea sense: {line}"]


def test_a_model_that_does_not_fit_is_told_in_one_line(tmp_path):
    left, right = images()
    good, deep = two_to_one(tmp_path / "good.onnx"), s2m2(tmp_path / "s2m2.onnx")
    broken, text = tmp_path / "broken.onnx", tmp_path / "text.onnx"
    broken.write_bytes((tmp_path / "good.onnx").read_bytes()[:40])
    text.write_text("no model")
    extra = [("flow_init", TensorProto.FLOAT, [1, 2, "h", "w"])]
    shape = [1, 3, *SIZE]
    pooled = write(
        tmp_path / "pooled.onnx",
        [("left", TensorProto.FLOAT, shape), ("right", TensorProto.FLOAT, shape)],
        [("Add", ["left", "right"], ["both"], {}), ("GlobalAveragePool", ["both"], ["mean"], {})],
        [("mean", TensorProto.FLOAT, [1, 3, 1, 1])],
    )
    alone = write(
        tmp_path / "alone.onnx",
        [("image", TensorProto.FLOAT, [1, 3, *SIZE])],
        [("Identity", ["image"], ["same"], {})],
        [("same", TensorProto.FLOAT, [1, 3, *SIZE])],
    )
    words = write(
        tmp_path / "words.onnx",
        [("left", TensorProto.INT64, shape), ("right", TensorProto.INT64, shape)],
        [("Add", ["left", "right"], ["both"], {})],
        [("both", TensorProto.INT64, shape)],
    )
    crash = write(
        tmp_path / "crash.onnx",
        [("left", TensorProto.FLOAT, ["b", 3, "h", "w"]), ("right", TensorProto.FLOAT, ["b", 3, "h", "w"])],
        [("Sub", ["left", "right"], ["both"], {}), ("Reshape", ["both", "form"], ["flat"], {})],
        [("flat", TensorProto.FLOAT, ["a", "b"])],
        [("form", np.array([7, 5], np.int64))],
    )
    cases = [
        (dict(), r"matcher\.model = None: expected an ONNX file: matcher\.model=FILE"),
        (dict(model=str(tmp_path / "none.onnx")), r"none\.onnx: expected an existing ONNX file"),
        (dict(model=str(broken)), "expected an ONNX model"),
        (dict(model=str(text)), "expected an ONNX model"),
        (dict(model=good, left="links"), r"matcher\.source\.left = links: expected an input of the model: left"),
        (dict(model=good, disparity="depth"), r"source\.disparity = depth: expected an output of the model: disp"),
        (dict(model=good, worth="conf"), r"matcher\.source\.worth = conf: expected an output"),
        (dict(model=two_to_one(tmp_path / "x.onnx", extra=extra)), "flow_init.*: expected two images"),
        (dict(model=good, left="left", right="left"), "expected one an image, or one for both"),
        (dict(model=alone), "inputs image .*: expected two images"),
        (dict(model=words), r"input left = tensor\(int64\): expected one of"),
        (dict(model=deep, size_px=[32, 96]), r"size_px = \[32, 96\]: expected \[64, 96\]"),
        (dict(model=good, size_px=[33, 96]), "multiples of"),
        (dict(model=good, size_px=96), "size_px = 96: expected a height and a width"),
        (dict(model=good, mean=[1, 2]), r"mean = \[1, 2\]: expected a number, or three"),
        (dict(model=good, mean=math.nan), "mean = nan"),
        (dict(model=good, std=0.0), r"std = 0\.0"),
        (dict(model=good, peak=0.0), r"peak = 0\.0"),
        (dict(model=good, multiple=0), "multiple = 0"),
        (dict(model=good, edge_px=0.0), r"edge_px = 0\.0"),
        (dict(model=pooled), r"output mean = shape \(1, 3, 1, 1\): expected \(1, 1, 64, 96\)"),
        (dict(model=crash), "expected a model that runs"),
    ]  # fmt: skip
    for settings, message in cases:
        with pytest.raises(SettingError, match=message) as caught:
            OnnxModel(**settings)(left, right)
        assert "\n" not in str(caught.value) and len(str(caught.value)) < 500
