"""The families of scenes: each can be built as it says, and what cannot is named."""

import pytest
import torch
from hydra import compose, initialize_config_dir

from torchfovea.cli import main
from torchfovea.commands.shared.build import build_observer, build_scene_of
from torchfovea.commands.shared.config import conf_dir
from torchfovea.commands.shared.rollout import roll_out
from torchfovea.commands.tune.command import build_problem
from torchfovea.perception import Eligibility, Observer, decide, new_memory
from torchfovea.sensing.head import Head
from torchfovea.tuning.scenes import draw_scenes, stream

FAMILIES = ["narrow", "small", "far", "twins", "marked", "marked_images"]


@pytest.mark.parametrize("family", FAMILIES)
def test_a_family_is_built_as_it_says(family):
    with initialize_config_dir(conf_dir(), version_base="1.3"):
        cfg = compose("search", overrides=[f"family={family}", "profile=reduced"])
    head = build_observer(cfg).head
    scene = build_scene_of(cfg, head, 1)
    again = build_scene_of(cfg, head, 1)
    marked = family in ("marked", "marked_images")
    assert cfg.scene.name == ("marked" if marked else family) and head.baseline_m == 0.065
    assert torch.equal(scene.nearest_point_e, again.nearest_point_e)
    cans = cfg.scene.get("cans") if marked else cfg.scene
    low, high = cans.range_m if marked else cans.target_range_m
    assert low - 0.1 < scene.nearest_range_m < high and scene.nearest.geom in scene.target_geoms
    assert sum(solid.name.startswith("can_") for solid in scene.solids) == cans.cans


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        (["scene.target_range_m=[0.31,0.32]"], "scene.target_range_m = (0.31, 0.32)"),
        (["scene.range_m=[1.2,1.3]", "scene.tries=20"], "scene.cans = 30: expected at most"),
        (["scene.pole_radius_m=0.02"], "scene.pole_radius_m = 0.02"),
    ],
)
def test_a_family_that_cannot_be_built_is_named(settings, named, tmp_path, capsys):
    small = ["family=small", "fidelity=geometric", "episodes=1", "saccades=2", "memory.cells=60", "picture=false"]
    assert main(["search", *small, *settings, f"hydra.run.dir={tmp_path}/run"]) == 1
    said = capsys.readouterr().err
    assert named in said and len(said.splitlines()) == 1


def test_a_noisy_floor_is_no_object():
    """Of many cells that see the floor, each with an honest error, those that noise lifts are not fixated."""
    rng = torch.Generator().manual_seed(0)
    v = torch.randn(2000, 3, generator=rng) * torch.tensor([0.3, 0.3, 0.15]) + torch.tensor([0.7, 0.0, -0.6])
    cells = torch.nn.functional.normalize(v, dim=-1)
    share = {}
    for sigmas in (0.0, 3.0):
        observer = Observer(head=Head(tilt_down_deg=80.0), eligibility=Eligibility(ground_sigmas=sigmas))
        memory = new_memory(observer, cells)
        rho, std = -cells[:, 2] / observer.head.ego_height_m, 0.15
        rho = rho + std * torch.randn(2000, generator=rng)
        matrix = memory.information.matrix.clone()
        matrix[:, 5] = std**-2
        vector = memory.information.vector.clone()
        vector[:, 2] = rho * std**-2
        votes = memory.votes.clone()
        votes[:, 0] = 3
        seen = memory._replace(
            information=type(memory.information)(vector, matrix), looks=memory.looks + 3, votes=votes
        )
        share[sigmas] = float(decide(observer, seen).eligible.float().mean())
    assert share[0.0] > 0.15 and share[3.0] < 0.01


@pytest.mark.parametrize("name", ["small", "far", "narrow", "told"])
def test_a_family_has_a_distribution_to_tune_on(name):
    with initialize_config_dir(conf_dir(), version_base="1.3"):
        cfg = compose("tune", overrides=[f"distribution={name}", "head=human"])
    problem = build_problem(cfg)
    scenes = draw_scenes(problem.distribution, problem.task.observer.head, 8, stream("training", 0))
    low, high = problem.distribution.target_range_m
    assert ((scenes.nearest_m > low - 0.1) & (scenes.nearest_m < high)).all()
    assert scenes.x.shape == (8, problem.distribution.cans)


def test_the_oracle_does_not_look_past_a_rim():
    """Cans whose nearest point lies on the rim, where the cells beside it believe the wall behind."""
    with initialize_config_dir(conf_dir(), version_base="1.3"):
        small = ["profile=reduced", "sensor.sample=4000", "acquisition=oracle", "memory=aimed", "saccades=3"]
        cfg = compose("search", overrides=["family=marked", *small])
    episodes = roll_out(cfg, build_observer(cfg), [15, 31])
    assert all(bool(episode.hit.any()) and float(episode.gap[-1]) > 0.99 for episode in episodes)
