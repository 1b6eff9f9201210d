"""Budgets: their formulas by hand, their files, and what errors have in common."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from synthetic import observations, without_clues

from torchfovea.cli import main
from torchfovea.commands.shared.budgets import build_budget, load_budget, made_for, shipped, write_budget
from torchfovea.commands.shared.config import conf_dir
from torchfovea.commands.shared.pairs import load_folder, named_pair
from torchfovea.commands.shared.regions import REGIONS, hidden_places, regions, truth_step_px
from torchfovea.sensing.correspondence import Budget, Clues, doubt, inlier_share
from torchfovea.sensing.kinship import once_a_pixel
from torchfovea.setting import SettingError
from torchfovea.studies.calibration import sigma_of
from torchfovea.studies.shared_errors import KnownLook, lasting_share_of, shared_share

# -------------------------------------------------------------------------------------------------------- the formulas


def random_clues(count, seed=0):
    rng = np.random.default_rng(seed)
    return Clues(*(torch.as_tensor(rng.exponential(2, count)) for _ in Clues._fields))


def test_clues_by_hand():
    budget = Budget(
        bend=0.5, gap=0.25, fringe=0.2, noise=1.5, outliers=0.04, outliers_gap=1.0,
        outliers_hidden=2.0, outliers_mismatch=3.0,
    )  # fmt: skip
    clues = random_clues(20)
    for i in range(20):
        b, g, f, n, c, h = (float(clue[i]) for clue in clues)
        assert doubt(budget, clues)[i].item() == pytest.approx(
            (0.5 * b) ** 2 + (0.25 * g) ** 2 + (0.2 * f) ** 2 + (1.5 * n) ** 2
        )
        odds = 0.04 / 0.96 * (1 + g) * (1 + h) ** 2 * math.exp(3 * c)
        assert inlier_share(budget, clues)[i].item() == pytest.approx(1 / (1 + odds))
    only = Clues(clues.bend_px, clues.gap_px)
    nothing = torch.zeros_like(clues.bend_px)
    rest = Clues(clues.bend_px, clues.gap_px, nothing, nothing, nothing, nothing)
    assert torch.equal(inlier_share(budget, only), inlier_share(budget, rest))
    assert torch.equal(doubt(budget, only), doubt(budget, rest))


@pytest.mark.parametrize("budget", [Budget(), Budget.printed, Budget(outliers_gap=3.0)])
def test_without_outliers_every_match_is_certain(budget):
    assert (inlier_share(budget, random_clues(50)) == 1).all()


def test_clues_have_gradients():
    budget = Budget(bend=0.5, gap=0.2, fringe=0.1, noise=1.0, outliers=0.1, outliers_gap=1.2)
    budget = replace(budget, outliers_hidden=0.7, outliers_mismatch=2.0)
    clues = tuple(clue.requires_grad_() for clue in random_clues(5, seed=1))
    assert torch.autograd.gradcheck(lambda *c: inlier_share(budget, Clues(*c)), clues)
    assert torch.autograd.gradcheck(lambda *c: doubt(budget, Clues(*c)), clues)


def test_one_field_a_source_pixel():
    rng = np.random.default_rng(0)
    px, valid = rng.normal(0, 3, (300, 2)), rng.random(300) < 0.8
    chosen = once_a_pixel(torch.as_tensor(px), 0.5, torch.as_tensor(valid)).numpy()
    cells = {}
    for i in np.flatnonzero(valid):
        cells.setdefault(tuple(np.round(px[i] / 0.5)), []).append(i)
    best = {min(those, key=lambda i: np.hypot(*(px[i] / 0.5 - np.round(px[i] / 0.5)))) for those in cells.values()}
    assert set(np.flatnonzero(chosen)) == best
    same = torch.zeros(4, 2)
    assert once_a_pixel(same, 1.0, torch.tensor([False, True, True, False])).tolist() == [False, True, False, False]
    assert once_a_pixel(same[:0], 1.0, torch.ones(0, dtype=torch.bool)).shape == (0,)


# ------------------------------------------------------------------------------------------------------------- regions


def test_regions_of_a_step():
    """A near square in front of a wall: its rim is an edge, and a strip to its left is hidden from the right eye."""
    disparity, image = torch.full((60, 80), 5.0), torch.rand(3, 60, 80, generator=torch.Generator().manual_seed(0))
    disparity[20:40, 40:60] = 12.0
    image[:, :8] = 0.5
    found = regions(disparity, image)
    hidden = torch.zeros(60, 80, dtype=torch.bool)
    hidden[20:40, 33:40] = True
    unsure = torch.zeros_like(hidden)
    unsure[20:40, 32] = True  # half a pixel
    assert torch.equal(hidden_places(disparity) & ~unsure, hidden)
    assert (found[hidden] == REGIONS.index("hidden")).all()
    assert found[15, 50] == found[30, 50 - 5] == REGIONS.index("edge") and found[30, 50] == REGIONS.index("smooth")
    assert found[2, 40] == REGIONS.index("weak_texture") and found[5, 70] == REGIONS.index("smooth")
    everywhere = torch.ones_like(hidden)
    assert (regions(disparity, image, everywhere) == REGIONS.index("hidden")).all()
    slanted = 5 + 0.3 * torch.arange(80.0).expand(60, 80)
    assert not hidden_places(slanted).any() and (regions(slanted, image)[20:] == 0).all()
    assert (regions(torch.full_like(slanted, math.nan), image)[20:] == 0).all()


def test_the_step_of_a_truth():
    rng = np.random.default_rng(0)
    smooth = torch.as_tensor(rng.uniform(3, 60, (50, 50)))
    assert truth_step_px((smooth * 3).round() / 3) == pytest.approx(1 / 3)
    assert truth_step_px(smooth) < 0.05 and truth_step_px(torch.full((4, 4), math.nan)) == 0


# ---------------------------------------------------------------------------------------------------------- the shares


PLACE = np.stack(np.meshgrid(np.arange(30.0), np.arange(30.0)), -1).reshape(-1, 2)
ROOT = np.linalg.cholesky(np.exp(-np.linalg.norm(PLACE[:, None] - PLACE, axis=-1) / 4) + 1e-9 * np.eye(900))


def field_of_errors(shared, seed):
    """A lattice of fields on one smooth surface whose errors share e^(-d/4) of their variance, beside noise."""
    rng = np.random.default_rng(seed)
    common = ROOT @ rng.normal(size=900)
    z = math.sqrt(shared) * common + math.sqrt(1 - shared) * rng.normal(size=900)
    data = without_clues(observations(900, Budget(), seed))
    one = torch.ones_like(data.error)
    data = data._replace(
        place_px=torch.as_tensor(PLACE), range_m=one, left_width_px=0.5 * one, right_width_px=0.5 * one,
        left_gain=0.05 * one, right_gain=0.05 * one,
    )  # fmt: skip
    return data._replace(error=sigma_of(data, Budget()) * torch.as_tensor(z))


@pytest.mark.parametrize("shared", [0.0, 0.4, 0.8])
def test_what_neighbours_share_is_found_again(shared):
    looks = [field_of_errors(shared, seed) for seed in range(150)]
    share, factor = shared_share(looks, Budget())
    assert share == pytest.approx(shared, abs=0.08) and (factor == 1 or shared == 0)
    if shared == 0.8:  # the same errors by a budget that takes them to reach farther
        assert shared_share(looks[:40], Budget(shared_px=4 / 0.45, shared_widths=4.0))[1] == 0.45
    elsewhere = [look._replace(region=torch.ones(900, dtype=torch.int64)) for look in looks]
    assert shared_share(elsewhere, Budget()) is None


@pytest.mark.parametrize("lasting", [0.0, 0.5])
def test_what_looks_share_is_found_again(lasting):
    scenes, half = [], math.radians(10)
    axes = [torch.tensor([math.sin(a), 0.0, math.cos(a)], dtype=torch.float64) for a in (-half, half)]
    for seed in range(8):
        rng = np.random.default_rng(seed)
        common, points = rng.normal(size=900), torch.as_tensor(rng.uniform(-1, 1, (900, 3)))
        looks = []
        for axis in axes:
            data = field_of_errors(0.0, seed)
            z = math.sqrt(lasting) * common + math.sqrt(1 - lasting) * rng.normal(size=900)
            data = data._replace(error=sigma_of(data, Budget()) * torch.as_tensor(z))
            looks.append(KnownLook(data, points, axis))
        scenes.append(looks)
    assert lasting_share_of(scenes, Budget()) == pytest.approx(lasting, abs=0.05)
    assert lasting_share_of([[look._replace(axis=axes[0]) for look in looks] for looks in scenes], Budget()) is None


# ----------------------------------------------------------------------------------------------------------- the files


def composed(*overrides, command="sense"):
    with initialize_config_dir(conf_dir(), version_base="1.3"):
        return compose(command, list(overrides))


@pytest.mark.parametrize("layout", ["log_polar", "uniform"])
@pytest.mark.parametrize("matcher", ["sgbm", "sweep"])
def test_auto_is_the_one_that_comes_along(layout, matcher, capsys):
    cfg = composed("budget=auto", f"sensor={layout}", f"matcher={matcher}")
    path = shipped(cfg)
    assert path is not None and path.name == f"{layout}_{matcher}.yaml"
    budget = build_budget(cfg)
    file = OmegaConf.load(path)
    assert all(getattr(budget, name) == file[name] for name in ("match_px", "bend", "outliers", "shared", "lasting"))
    assert 0 < budget.outliers < 0.5 and 0 < budget.shared < 1 and file.made_for.matcher.name == matcher
    assert capsys.readouterr().err == ""
    assert (
        build_budget(composed("budget=auto", f"sensor={layout}", f"matcher={matcher}", "budget.bend=0.7")).bend == 0.7
    )


def test_auto_says_when_there_is_none(capsys):
    cfg = composed("budget=auto", "matcher=external")
    assert shipped(cfg) is None and build_budget(cfg) == Budget()
    line = capsys.readouterr().err
    assert "none comes along for log_polar and external" in line and len(line.splitlines()) == 1


def test_a_budget_elsewhere_is_told(capsys):
    build_budget(composed("budget=log_polar_sgbm", "matcher=sgbm"))
    assert capsys.readouterr().err == ""
    build_budget(composed("budget=log_polar_sgbm", "matcher=sgbm", "sensor=uniform", "matcher.block_px=9"))
    line = capsys.readouterr().err
    assert "sensor.layout = log_polar; matcher.block_px = 5" in line and len(line.splitlines()) == 1
    build_budget(composed("budget=log_polar_sgbm", "matcher=sgbm", "sensor.fov_deg=20"), pair=True)
    assert capsys.readouterr().err == ""  # a pair brings its own
    build_budget(composed("budget=log_polar_sgbm", "matcher=sgbm", "sensor.fov_deg=20", "sensor.source_px=3000"))
    assert "sensor.source_px" in (line := capsys.readouterr().err) and "sensor.fov_deg" in line


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda text: text.replace("match_px: ", "match_pixels: "), r"budget\.match_px = missing"),
        (lambda text: text + "magic: 3\n", r"budget\.magic = 3: expected one of"),
        (lambda text: text.replace("bend: ", "bend: wide #"), r"budget\.bend = wide.*: expected a number"),
        (lambda text: text.replace("source: true", "source: ''"), r"budget\.source = : expected true or false"),
    ],
)
def test_a_wrong_budget_is_one_line(tmp_path, change, line):
    text = (Path(conf_dir()) / "budget" / "ours.yaml").read_text()
    cfg = composed()
    cfg.budget = OmegaConf.create(change(text))
    with pytest.raises(SettingError, match=line):
        build_budget(cfg)


@pytest.mark.parametrize("text", ["{ no yaml", "- 1\n- 2\n", "words\n", "sigma_over_width: [1\n"])
def test_a_broken_file_is_one_line(tmp_path, monkeypatch, capsys, text):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "budget").mkdir()
    (tmp_path / "budget" / "mine.yaml").write_text(text)
    assert main(["sense", "--config-dir", str(tmp_path), "budget=mine", "pair=motorcycle"]) != 0
    printed = capsys.readouterr().err
    assert printed.startswith("torchfovea sense: ") and len(printed.splitlines()) == 1 and "budget" in printed


def test_a_budget_is_read_as_it_was_written(tmp_path):
    cfg = composed("matcher=sgbm")
    budget = Budget(0.12, 400, 0.3, bend=0.5, outliers=0.031, outliers_gap=1.2, shared=0.4, lasting=0.1)
    write_budget(tmp_path / "fitted.yaml", budget, ["Fitted by hand"], "ours", made_for(cfg, [90.0], [400]))
    cfg.budget = OmegaConf.load(tmp_path / "fitted.yaml")
    cfg.sensor.fov_deg = 90
    assert build_budget(cfg) == budget


# ------------------------------------------------------------------------------------------------------------ the pairs


def write_pair(folder, **changes):
    import cv2

    folder.mkdir(exist_ok=True)
    texture = np.random.default_rng(0).integers(0, 255, (40, 60), np.uint8)
    cv2.imwrite(str(folder / "left.png"), texture[:, :50])
    cv2.imwrite(str(folder / "right.png"), texture[:, 10:])
    np.save(folder / "disparity.npy", np.full((40, 50), 10, np.float32))
    lines = {"cam0": "[90 0 25; 0 90 20; 0 0 1]", "doffs": "3.5", "baseline": "120", "width": "50"} | changes
    (folder / "calib.txt").write_text("".join(f"{k}={v}\n" for k, v in lines.items() if v is not None))
    return folder


def test_a_folder_is_a_pair(tmp_path):
    pair = load_folder(write_pair(tmp_path / "a"), "pairs[0]")
    assert (pair.camera_left.focal_px, pair.camera_left.cx_px, pair.camera_left.cy_px) == (90, 25, 20)
    assert pair.camera_right.cx_px == 28.5 and pair.baseline_m == 0.12 and pair.disparity is not None
    assert pair.depth_m(pair.disparity)[0, 0].item() == pytest.approx(90 * 0.12 / 13.5)


@pytest.mark.parametrize(
    ("spoil", "line"),
    [
        (lambda f: (f / "calib.txt").unlink(), "calib.txt"),
        (lambda f: (f / "disparity.npy").unlink(), "disparity = 0: expected one file"),
        (lambda f: write_pair(f, doffs="far"), r"pairs\[0\]: .*expected numbers of a calibration .*'far'"),
        (lambda f: write_pair(f, baseline=None), r"calib.txt: expected baseline, which it lacks"),
        (
            lambda f: write_pair(f, baseline="-3"),
            r"calib.txt: right camera .*\(-0.003, 0, 0\) m: expected it to the right",
        ),
        (lambda f: write_pair(f, cam0="[90 0 25; 0 91 20; 0 0 1]"), "raw cameras: expected those of a rectified pair"),
        (lambda f: write_pair(f, height="41"), "size = 50x41: expected 50x40 px"),
        (lambda f: np.save(f / "disparity.npy", np.ones((3, 4), np.float32)), r"disparity = \(3, 4\)"),
    ],
)
def test_a_spoilt_folder_is_one_line(tmp_path, spoil, line):
    folder = write_pair(tmp_path / "a")
    spoil(folder)
    with pytest.raises(SettingError, match=line):
        named_pair(str(folder), "pairs[0]")


@pytest.mark.parametrize("name", ["log_polar_sgbm", "uniform_sweep_rendered", "printed", "ours"])
def test_a_budget_is_read_by_its_name(name):
    budget = load_budget(name, 300)
    assert budget.source_px == (None if name == "printed" else 300)
    assert (budget.outliers > 0) == ("_" in name)
    with pytest.raises(SettingError, match=r"budget = nobody's: expected one of .*log_polar_sgbm"):
        load_budget("nobody's")
