"""The paper's Fig. 1: one scene in colour, and through both retinas, coloured by precision."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from skimage.data import stereo_motorcycle

from torchfovea.cli import main
from torchfovea.commands.search.figure1 import draw_scene, sensors_of
from torchfovea.commands.sense.figure1 import AT_HOME
from torchfovea.commands.shared import pictures
from torchfovea.commands.shared.build import build_observer
from torchfovea.commands.shared.composed import compose_search
from torchfovea.commands.shared.pictures import draw_precision
from torchfovea.commands.shared.precision import bearings_deg, measured
from torchfovea.gaussian import Gaussian
from torchfovea.sensing.head import Eyes, Gaze, eyes

SMALL = ("episodes=1", "saccades=2", "memory.cells=100", "picture=false", "scene=cans", "sensor.fov_deg=90")


@pytest.fixture
def drawn(monkeypatch):
    """What is given to be drawn."""
    found = []
    monkeypatch.setattr(pictures, "draw_precision", lambda *given: found.append(given))
    return found


def run(*words):
    assert main(list(words)) == 0
    return Path(words[-1].partition("=")[2])


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    """The motorcycle at half its size, as a user's own files: settings of `sense`, and its truth's."""
    folder = tmp_path_factory.mktemp("pair")
    left, right, disparity = stereo_motorcycle()
    for name, image in (("left", left), ("right", right)):
        Image.fromarray(image[::2, ::2]).save(folder / f"{name}.png")
    np.save(folder / "truth.npy", disparity[::2, ::2] / 2)
    files = [f"{name}={folder}/{name}.png" for name in ("left", "right")]
    numbers = ("focal_px=497.489", "cx_px=155.5965", "cy_px=127.4385", "doffs_px=15.543", "baseline_m=0.193")
    return [*files, *numbers, "health=off", "figure1=true"], f"disparity={folder}/truth.npy"


def test_a_pair(tmp_path, drawn, pair):
    files, truth = pair
    run("sense", *files, truth, "sensor.receptive_fields=3000", f"hydra.run.dir={tmp_path}")
    _, true, clouds, _ = drawn[0]
    assert [cloud.name.partition(",")[0] for cloud in clouds] == ["uniform", "log-polar"]
    numbers = [int(cloud.name.split()[1].replace(",", "")) for cloud in clouds]
    assert numbers == pytest.approx([3000, 3000], rel=0.01)
    # the best points of a fovea are more precise than those of the uniform retina
    even, foveal = (float(cloud.colour.double().quantile(0.95)) for cloud in clouds)
    assert foveal > even + 1
    # every true point stands where the picture has its colour: column and row by the camera of the pair
    left = stereo_motorcycle()[0][::2, ::2] / 255
    x, y, z = np.asarray(true.points_m).T
    row, column = np.round(497.489 * y / z + 127.4385).astype(int), np.round(497.489 * x / z + 155.5965).astype(int)
    assert len(x) > 10_000 and np.abs(left[row, column] - np.asarray(true.colour)).max() < 1e-6


def test_the_end_of_a_search(tmp_path, drawn):
    words = (*SMALL, "sensor.source_px=200", "sensor.receptive_fields=1500", "figure1=true")
    run("search", *words, "seed=3", f"hydra.run.dir={tmp_path}")
    path, true, clouds, frame = drawn[0]
    assert path == tmp_path / "figure1.png" and len(clouds) == 2
    surfaces = true.points_m
    for cloud in clouds:  # what was measured lies on what is there
        apart = torch.cdist(cloud.points_m, surfaces.float()).amin(1) / cloud.points_m.norm(dim=-1)
        assert len(cloud.points_m) > 500 and apart.median() < 0.03
    assert true.seen_deg.abs().max() <= 45.5  # of a view of 90 degrees
    draw_precision(path, true, clouds, frame)
    with Image.open(path) as picture:
        assert picture.width >= 1200


def test_without_images_and_without_truth(tmp_path, drawn, pair):
    """The geometric sensor has the figure, too; a pair without truth shows what was measured."""
    cfg = compose_search((*SMALL, "fidelity=geometric", "sensor.receptive_fields=800", "figure1=true"))
    observer = build_observer(cfg)
    draw_scene(tmp_path / "figure1.png", sensors_of(cfg, observer), 0, Gaze(*torch.zeros(3, dtype=torch.float64)))
    run("sense", *pair[0], "sensor.receptive_fields=1000", f"hydra.run.dir={tmp_path}/run")
    (_, room, geometric, _), (_, shown, clouds, _) = drawn
    assert len(geometric) == 2 and len(room.points_m) > 1000
    assert "measured" in shown.name and len(shown.points_m) >= len(clouds[1].points_m) > 500


def test_precision_is_the_determinant_and_doubt_is_left_out():
    root = torch.randn(6, 3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    full = root @ root.mT
    packed = torch.stack([full[:, i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))], -1)
    valid = torch.tensor([True, True, False, True, True, True])
    inlier = torch.tensor([0.9, 0.2, 0.9, 0.8, 0.7, 0.6])
    cloud = measured("any", AT_HOME, Gaussian(torch.rand(6, 3), packed), valid, inlier)
    expected = [-np.linalg.slogdet(full[i].numpy())[1] for i in (0, 3, 4, 5)]
    assert cloud.colour.tolist() == pytest.approx(expected)


def test_seen_from_an_eye():
    """A point on the eye's axis is at 0; right is positive, and so is up."""
    pose = eyes(compose_head(), Gaze(*torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64)))
    right, down, axis = pose.R_left.unbind(-1)
    points = pose.t_left + torch.stack([2 * axis, axis + right, axis - down * 0.5, axis + right - down])
    expected = [[0, 0], [45, 0], [0, np.degrees(np.arctan(0.5))], [45, np.degrees(np.arctan(1 / np.sqrt(2)))]]
    assert np.allclose(bearings_deg(pose, points), expected, atol=1e-9)
    home = Eyes(torch.eye(3), torch.zeros(3), torch.eye(3), torch.zeros(3))
    assert bearings_deg(home, torch.tensor([[1.0, 1.0, 1.0]]))[0, 1] < 0  # down in the camera's frame


def compose_head():
    return build_observer(compose_search(SMALL)).head


@pytest.mark.parametrize(
    ("words", "line"),
    [
        (("search", *SMALL, "figure1=1"), "figure1 = 1: expected true or false"),
        (("search", *SMALL, "figure1=true", "motion=path"), "figure1 = True: expected false with a base that moves"),
        (("search", "family=marked", "fidelity=geometric", "figure1=true"), "figure1 = True: expected false with"),
        (
            ("sense", "pair=motorcycle", "sensor=every_pixel", "figure1=true"),
            "sensor.layout = every_pixel: expected one of uniform, log_polar",
        ),
    ],
)
def test_a_mistake_is_one_line(words, line, tmp_path, capsys):
    assert main([*words, f"hydra.run.dir={tmp_path}/run"]) == 1
    assert line in capsys.readouterr().err.splitlines()[-1]
