"""Marks in pictures: how they are painted, what fields see of them, and what that tells of the class."""

import math

import numpy as np
import pytest
import torch
from hydra import compose, initialize_config_dir

from torchfovea.cli import main
from torchfovea.commands.shared.build import build_arena, build_observer
from torchfovea.commands.shared.config import conf_dir
from torchfovea.looking import look_at
from torchfovea.memory.classes import Classes
from torchfovea.perception import Observer
from torchfovea.sensing.correspondence import Correspondences
from torchfovea.sensing.head import fixate
from torchfovea.sensing.layout import LogPolar, Uniform
from torchfovea.sensing.retina import fovea
from torchfovea.setting import SettingError
from torchfovea.sim.texture import Paint, colour
from torchfovea.stereo.rig import verged
from torchfovea.stereo.stripes import Stripes, StripesShown, direction_votes
from torchfovea.stereo.views import verged_views

SIDE = 256  # of the images
STRIPES = "reward={count: 3, evidence: {_target_: torchfovea.stereo.stripes.Stripes}}"


def image_of(angle, period_px):
    """Grey stripes whose brightness changes along an angle from x to y, by NumPy."""
    y, x = np.mgrid[:SIDE, :SIDE] - (SIDE - 1) / 2
    wave = 0.5 + 0.3 * np.sin(2 * np.pi / period_px * (x * np.cos(angle) + y * np.sin(angle)))
    return torch.tensor(np.stack([wave] * 3), dtype=torch.float32)


def votes_of(image, retina, weight=1.0):
    values = fovea(image[None], None, retina)[0]
    step = (retina.width_px(retina.centers_px()) ** 2 + (2 * retina.radius_px / SIDE) ** 2).sqrt()
    return direction_votes(values, torch.full_like(values[0], weight), retina, step)


@pytest.mark.parametrize("degrees", [10.0, 45.0, 90.0, 135.0, 170.0])
def test_fields_that_resolve_stripes_vote_for_their_direction(degrees):
    angle = math.radians(degrees)
    retina = LogPolar(4000)
    votes = votes_of(image_of(angle, 16), retina)
    fine = retina.width_px(retina.centers_px()) * SIDE / (2 * retina.radius_px) < 4
    fine &= retina.centers_px().norm(dim=-1) < 60
    assert fine.sum() > 500
    mean = votes[fine].mean(0)
    wanted = torch.tensor([math.cos(2 * angle), math.sin(2 * angle)])
    assert float(mean.norm()) > 0.6 and float(mean @ wanted / mean.norm()) > 0.99
    # what does not count has no voice, and grey has no direction
    assert votes_of(image_of(angle, 16), retina, 0.0).abs().max() == 0
    assert votes_of(torch.full((3, SIDE, SIDE), 0.5), retina).abs().max() < 1e-6


def test_fields_wider_than_the_stripes_see_grey():
    wide = votes_of(image_of(math.pi / 4, 8), Uniform(100))
    assert wide.norm(dim=-1).mean() < 0.05


def test_votes_are_differentiable():
    retina = LogPolar(60)
    rng = torch.Generator().manual_seed(0)
    values = torch.rand(3, retina.count, generator=rng, dtype=torch.float64) * 0.5 + 0.25
    weight = torch.rand(retina.count, generator=rng, dtype=torch.float64)
    step = retina.width_px(retina.centers_px(dtype=torch.float64)) * 0.37
    given = values.requires_grad_(), weight.requires_grad_()
    assert torch.autograd.gradcheck(lambda c, w: direction_votes(c, w, retina, step), given, fast_mode=True)


def test_the_likelihood_is_as_it_says():
    stripes = Stripes(marks=3, detail_m=0.01, concentration=5.0, redness=4.0, red=0.5)
    rng = np.random.default_rng(0)
    votes, red, width = rng.uniform(-0.7, 0.7, (20, 2)), rng.uniform(0, 1, 20), rng.uniform(0, 0.03, 20)
    width[0] = np.inf
    found = stripes.likelihood(StripesShown(*(torch.tensor(part) for part in (votes, red, width))))
    for n in range(20):
        wanted = [1.0]
        for mark in (1, 2, 3):
            angle = math.pi * (mark - 0.5) / 3  # above the horizontal, where an image's y points down
            agreed = votes[n, 0] * math.cos(2 * angle) - votes[n, 1] * math.sin(2 * angle)
            share = math.exp(-((width[n] / 0.01) ** 2))
            wanted.append(math.exp(4.0 * (red[n] - 0.5) + 5.0 * share * agreed))
        np.testing.assert_allclose(found[n], wanted, rtol=1e-9)
    assert torch.equal(found[0, 1:], found[0, 1].expand(3))  # no range, no detail


def test_stripes_are_painted_as_their_numbers_say():
    radius, half, around, up, contrast = 0.05, 0.08, 14, 40.0, 0.4
    rng = np.random.default_rng(1)
    angle, height = rng.uniform(-np.pi, np.pi, 64), rng.uniform(-0.7, 0.7, 64) * half
    point = np.stack([radius * np.cos(angle), radius * np.sin(angle), height])
    normal = np.stack([np.cos(angle), np.sin(angle), 0 * angle])
    parts = [[torch.tensor(p[None], dtype=torch.float32) for p in whole] for whole in (point, normal)]

    def painted(strength, footprint_m):
        paint = Paint(
            torch.tensor([0.5, 0.1, 0.1, 0.5, 0.1, 0.1, 0.3])[:, None],
            torch.zeros(3, 1),
            torch.zeros(3, 1),
            torch.tensor([[radius], [half]]),
            torch.tensor([[around], [up], [strength]]),
            torch.full((1,), torch.inf),
        )
        width = torch.full((1, 64), footprint_m)
        return colour(paint, torch.zeros(1, 64, dtype=torch.int64), *parts, width)[:, 0].double().numpy()

    for footprint in (0.0005, 0.01):
        frequency = math.hypot(around / (2 * math.pi * radius), up)  # periods per metre, across the stripes
        fade = math.exp(-2 * (math.pi * 0.45 * footprint * frequency) ** 2)
        wanted = 1 + contrast * fade * np.sin(around * angle + 2 * np.pi * up * height)
        found = painted(contrast, footprint) / painted(1e-9, footprint)
        np.testing.assert_allclose(found, np.stack([wanted] * 3), rtol=2e-4)


@pytest.fixture(scope="module")
def looks():
    """Each retina's look at the target and at another can: true class, and the likelihoods of the can's fields."""
    found = {}
    for name in ("log_polar", "uniform"):
        with initialize_config_dir(conf_dir(), version_base="1.3"):
            cfg = compose("search", overrides=["family=marked_images", f"sensor={name}"])
        observer = build_observer(cfg)
        arena = build_arena(cfg, observer, 12)
        scene, retina = arena.world.scene, observer.retina
        marks = scene.marks.of_geom
        for mark in (1, 2):
            geom = int((marks == mark).nonzero()[0, 0])
            middle = torch.tensor(scene.solids[geom].position_m) - torch.tensor([0, 0, observer.head.ego_height_m])
            gaze = fixate(observer.head, middle.double())[0]
            seen = arena.look(gaze, torch.Generator().manual_seed(0)).matches
            frame = arena.world.images(gaze)[0]
            place = (seen.left_px * cfg.sensor.source_px / (2 * retina.radius_px) + cfg.sensor.source_px / 2).long()
            place = place.clamp(0, cfg.sensor.source_px - 1)
            on = seen.valid & (frame.geom[place[:, 1], place[:, 0]] == geom)
            found[name, mark] = seen.classes[on]
    return found


def test_a_fovea_tells_the_marks_of_rendered_cans_and_a_uniform_retina_does_not(looks):
    for mark in (1, 2):
        fine, coarse = (looks[name, mark].log() for name in ("log_polar", "uniform"))
        assert len(fine) > 100 and len(coarse) > 5
        other = 3 - mark
        assert (fine[:, mark] > fine[:, other]).float().mean() > 0.9
        assert (fine[:, mark] - fine[:, other]).median() > 3
        assert (coarse[:, mark] - coarse[:, other]).abs().median() < 1
        # that it is a can both retinas see
        assert fine[:, mark].median() > 2 and coarse[:, 1:].amax(-1).median() > 1


def matched(views, retina, budget):
    """A matcher that finds nothing."""
    px = retina.centers_px()
    nothing = torch.zeros(retina.count)
    return Correspondences(px, px, nothing + 1, nothing + 1, nothing > 0), None


def test_mistakes_are_named(tmp_path, capsys):
    with pytest.raises(SettingError, match=r"evidence.marks = 1: expected 2 to 63 marks"):
        Stripes(marks=1)
    with pytest.raises(SettingError, match=r"evidence.red = 2"):
        Stripes(red=2)
    with pytest.raises(SettingError, match=r"evidence = int: expected a function"):
        Classes(evidence=3)
    views = verged_views(*[torch.rand(3, 64, 64)] * 2, verged(0.05, 0.065), Observer().camera, 100.0)
    for evidence, named in (
        (None, "classes.evidence = None"),
        (lambda *_: torch.ones(4, 2), r"classes.evidence = .*expected positive likelihoods"),
        (lambda views, retina, matches: torch.zeros(retina.count, 2), "classes.evidence"),
    ):
        observer = Observer(retina=LogPolar(100), classes=Classes(2, 1, evidence=evidence))
        with pytest.raises(SettingError, match=named):
            look_at(observer, views, matched)
    small = ["search", "episodes=1", "saccades=2", "memory.cells=60", "picture=false", f"hydra.run.dir={tmp_path}/run"]
    for settings, named in (
        (["family=marked_images", "reward.count=4"], "reward.count = 4: expected 3, one more than"),
        (["family=marked_images", "scene.marks=3"], "reward.count = 3: expected 4, one more than"),
        (["family=marked_images", "reward.evidence=null"], "reward = of_class: expected motion=still"),
        (["family=marked_images", "reward.evidence.detail_m=-1"], "evidence.detail_m = -1"),
        (["fidelity=photometric", "reward=of_class", STRIPES], "reward = of_class: expected a scene whose things bear"),
    ):
        assert main([*small, *settings]) == 1
        said = capsys.readouterr().err
        assert named in said and len(said.splitlines()) == 1, (settings, said)
    assert not (tmp_path / "run").exists()
