"""No name in a file, and no name that a setting gives to something, leads out of the folder that it belongs to."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from torchfovea.cli import main
from torchfovea.commands.shared.manifest import MANIFEST, unchanged
from torchfovea.recordings.folder import Folder, Recorder
from torchfovea.recordings.frames import Calibration
from torchfovea.sensing.camera import Pinhole
from torchfovea.sensing.head import Gaze, Head
from torchfovea.setting import SettingError, require_name
from torchfovea.stereo.onnx_model import OnnxModel
from torchfovea.tuning.scenes import Distribution
from torchfovea.untrusted import Damaged, path_within

OUT = ["../x", "a/../../x", "/etc/x", "..", "..\\x", "C:\\x", "C:x", "\\\\host\\x"]


@pytest.mark.parametrize("name", OUT)
def test_a_path_in_data_stays_in_its_folder(tmp_path, name):
    with pytest.raises(Damaged):
        path_within(tmp_path, name)
    assert path_within(tmp_path, "left/000001.png") == tmp_path / "left" / "000001.png"
    assert path_within(tmp_path, "a..b") == tmp_path / "a..b"


@pytest.mark.parametrize("name", [*OUT, "a/b", "", ".", ".hidden", "a\0", None, 1])
def test_a_name_is_no_path(name):
    with pytest.raises(SettingError, match=r"(?s)memory.name = .*: expected a name, without a path"):
        require_name(name, "memory.name")
    for good in ("left_below", "v1.2", "two words", "Größe"):
        require_name(good, "memory.name")


@pytest.mark.parametrize("name", ["../left/000000.png", "absolute"])
def test_a_recording_names_its_own_images(tmp_path, name):
    camera, image = Pinhole(30.0, 4.0, 3.0), torch.rand(3, 6, 8)
    gaze = Gaze(*(torch.zeros(3).unbind()))
    for folder in ("it", "left"):
        recorder = Recorder(tmp_path / folder, Calibration(camera, camera, (8, 6), Head()))
        recorder.write(0.0, image, image, gaze)
    (tmp_path / "left" / "000000.png").write_bytes((tmp_path / "left" / "left" / "000000.png").read_bytes())
    table = tmp_path / "it" / "frames.csv"
    name = str(tmp_path / "left" / "000000.png") if name == "absolute" else name
    assert (table.parent / name).is_file()
    table.write_text(table.read_text().replace("left/000000.png", name))
    refused = []
    (frame,) = Folder(tmp_path / "it").frames(refused.append)
    assert frame.left is None and frame.right is None
    assert f"frame = {name}: expected an image within {table.parent}" in str(refused[0])


def test_a_manifest_names_its_own_files(tmp_path):
    (tmp_path / MANIFEST).write_text(json.dumps({"config_hash": "x", "sha256": {"../other.csv": "0"}}))
    with pytest.raises(SettingError, match=r"manifest.json: ../other.csv: expected a file of the run"):
        unchanged(tmp_path)


@pytest.mark.parametrize("place", ["../secret", "absolute"])
def test_a_network_names_its_own_weights(tmp_path, place):
    """ONNX Runtime refuses them, and in one line."""
    onnx = pytest.importorskip("onnx")
    pytest.importorskip("onnxruntime")
    place = str(tmp_path / "secret") if place == "absolute" else place
    np.ones(12, np.float32).tofile(tmp_path / "secret")
    weights = onnx.TensorProto(name="w", data_type=1, dims=[1, 3, 2, 2], data_location=onnx.TensorProto.EXTERNAL)
    entry = weights.external_data.add()
    entry.key, entry.value = "location", place
    inputs = [onnx.helper.make_tensor_value_info(name, 1, [1, 3, 2, 2]) for name in ("left", "right")]
    nodes = [onnx.helper.make_node("Add", ["left", "w"], ["y"])]
    graph = onnx.helper.make_graph(nodes, "g", inputs, [onnx.helper.make_tensor_value_info("y", 1, None)], [weights])
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=8)
    (tmp_path / "model").mkdir()
    path = tmp_path / "model" / "it.onnx"
    path.write_bytes(model.SerializeToString())
    with pytest.raises(SettingError, match=r"matcher.model = ") as caught:
        OnnxModel(path)
    assert "\n" not in str(caught.value)


def test_a_bag_names_its_own_parts(tmp_path):
    """Rosbags reads a part by its last name, beside metadata.yaml."""
    rosbag2 = pytest.importorskip("rosbags.rosbag2")
    from torchfovea.recordings.bag import Bag

    with rosbag2.Writer(tmp_path / "bag", version=8):
        pass
    (part,) = (tmp_path / "bag").glob("*.db3")
    part.rename(tmp_path / "other.db3")
    told = tmp_path / "bag" / "metadata.yaml"
    told.write_text(told.read_text().replace(part.name, "../other.db3"))
    with pytest.raises(SettingError, match=r"expected a ROS 2 bag that can be read"):
        Bag(tmp_path / "bag")


def test_what_a_setting_names_is_written_in_the_run_folder(tmp_path, capsys):
    with pytest.raises(SettingError, match=r"distribution.name = ../x: expected a name"):
        Distribution(name="../x")
    run = tmp_path / "a" / "run"
    assert main(["tune", "profile=quick", "distribution.name=../../../x", f"hydra.run.dir={run}"]) == 1
    assert main(["search", "matcher.name=../x", "+matcher.source=a:b", f"hydra.run.dir={run}"]) == 1
    said = capsys.readouterr().err.splitlines()
    assert "distribution.name = ../../../x: expected" in said[0] and "matcher.name = ../x: expected" in said[-1]
    assert {path.name for path in Path(tmp_path).iterdir()} <= {"a"}
