"""Things told apart by marks: what fields read, what cells believe of it, and what the search makes of that."""

import math

import pytest
import torch

from torchfovea.arena import stack
from torchfovea.cli import main
from torchfovea.deciding.reward import RewardBelief, of_class
from torchfovea.episode import Rules, run_episodes
from torchfovea.memory.association import Pairs
from torchfovea.memory.classes import Classes, class_moments, join_evidence, new_classes
from torchfovea.memory.moving import resample
from torchfovea.memory.sphere import fibonacci_directions
from torchfovea.memory.store import load_memory, save_memory
from torchfovea.perception import Observer, decide, new_memory
from torchfovea.sensing.camera import Pinhole
from torchfovea.sensing.correspondence import Budget
from torchfovea.sensing.head import Gaze, Head
from torchfovea.sensing.layout import LogPolar, Uniform
from torchfovea.sensing.marks import field_width_rad, read_marks, readable
from torchfovea.setting import SettingError
from torchfovea.sim.arenas import GeometricArenas
from torchfovea.sim.cans import Cans
from torchfovea.sim.marked import Marked
from torchfovea.sim.scene import build_scene
from torchfovea.sim.truth import truth_of

CANS = Cans(cans=4, margin_m=0.02, tries=200)
CLASSES = Classes(count=4, sought=2)


def one_cell(belief, likelihood):
    """A look at one cell through fields of these likelihoods (N, K)."""
    n = len(likelihood)
    pairs = Pairs(torch.arange(n), torch.zeros(n, dtype=torch.int64))
    return join_evidence(belief[None], likelihood, pairs)[0]


def test_a_look_leaves_the_moments_of_the_mixture():
    alpha, likelihood = torch.tensor([0.3, 0.6, 1.5]), torch.tensor([[0.8, 0.1, 0.1]])
    weight = alpha * likelihood[0] / (alpha * likelihood[0]).sum()
    torch.manual_seed(0)
    draws = torch.cat(
        [
            torch.distributions.Dirichlet(alpha + torch.eye(3)[k]).sample((round(400000 * float(weight[k])),))
            for k in range(3)
        ]
    )
    found = torch.distributions.Dirichlet(one_cell(alpha, likelihood))
    torch.testing.assert_close(found.mean, draws.mean(0), atol=2e-3, rtol=0)
    torch.testing.assert_close(found.variance.sum(), draws.var(0).sum(), atol=2e-3, rtol=0)


def test_what_tells_nothing_changes_nothing_and_fields_of_a_cell_are_one_witness():
    alpha = torch.tensor([0.3, 0.6, 1.5], dtype=torch.float64)
    torch.testing.assert_close(one_cell(alpha, torch.full((9, 3), 0.2, dtype=torch.float64)), alpha)
    one = torch.tensor([[0.8, 0.1, 0.1]], dtype=torch.float64)
    torch.testing.assert_close(one_cell(alpha, one.expand(50, 3)), one_cell(alpha, one))
    assert torch.equal(join_evidence(alpha[None], one[:0], Pairs(*torch.zeros(2, 0, dtype=torch.int64)))[0], alpha)


def test_the_reward_of_a_class_has_the_moments_of_the_product():
    rng = torch.Generator().manual_seed(0)
    torch.manual_seed(0)
    share = torch.distributions.Beta(1.2, 0.7).sample((400000,))
    reward = 0.8 + 0.3 * torch.randn(400000, generator=rng)
    belief = torch.tensor([[1.2, 0.7]])
    mean, variance = class_moments(belief, 0)
    found = of_class(RewardBelief(torch.tensor([0.8]), torch.tensor([0.3])), mean, variance)
    product = share * reward
    torch.testing.assert_close(found.mean[0], product.mean(), atol=2e-3, rtol=0)
    torch.testing.assert_close(found.std[0], product.std(), atol=2e-3, rtol=0)


def test_fields_read_what_they_resolve():
    share = readable(torch.tensor([0.0, 0.004, 0.02]), 0.004)
    torch.testing.assert_close(share, torch.tensor([1.0, math.exp(-1), math.exp(-25)]))
    mark = torch.full((30000,), 2)
    likelihood = read_marks(mark, torch.full((30000,), 0.4), 4, torch.Generator().manual_seed(0))
    torch.testing.assert_close(likelihood.sum(-1), torch.full((30000,), 1.0))
    right = (likelihood.argmax(-1) == 2).float().mean()  # those that read it, and one guess in four
    assert float(right) == pytest.approx(0.4 + 0.6 / 4, abs=0.01)
    # calibrated: of the readings that a likelihood calls a class, that share is of it
    assert float(likelihood.max()) == pytest.approx(0.55)


def test_a_field_is_as_wide_as_its_layout_and_the_source_image_make_it():
    camera, here = Pinhole.from_fov(90.0, 100.0), torch.tensor([[0.0, 0.0], [70.0, 0.0]])
    budget = Budget(source_px=400)
    width = field_width_rad(camera, Uniform(400), budget, here)
    alone = float(Uniform(400).width_px(here)[0])
    wanted = math.hypot(alone, 0.5) / camera.focal_px
    assert float(width[0]) == pytest.approx(wanted, rel=1e-3)
    assert float(width[1]) == pytest.approx(wanted / (1 + 0.7**2), rel=1e-2)  # a pinhole's pixels shrink outward
    fine = field_width_rad(camera, LogPolar(400), Budget.printed, torch.tensor([[1.5, 0.0], [90.0, 0.0]]))
    assert fine[0] < fine[1] / 10


def test_the_target_is_not_the_nearest_and_bears_the_only_mark_that_is_sought():
    scene = build_scene(Marked(CANS, marks=3, sought=2), 1, Head())
    (target,) = scene.target_geoms
    marks = scene.marks.of_geom
    assert (marks == 2).sum() == 1 and marks[target] == 2
    assert sorted(set(marks.tolist())) in ([0, 1, 2], [0, 2, 3], [0, 1, 2, 3])
    assert scene.nearest.geom == target
    plain = build_scene(CANS, 1, Head())
    assert plain.nearest.range_m < scene.nearest.range_m


def arenas(retina, scenes, classes=CLASSES):
    observer = Observer(camera=Pinhole.from_fov(90.0, 100.0), retina=retina, classes=classes)
    return observer, GeometricArenas(scenes, observer)


def test_marks_are_read_alike_in_any_batch():
    scenes = [build_scene(Marked(CANS, marks=3, sought=2), seed, Head()) for seed in (1, 2)]
    observer, both = arenas(LogPolar(600), scenes)
    zero = torch.zeros(2)
    together = both.look(Gaze(zero, zero, zero), [torch.Generator().manual_seed(s) for s in (5, 6)]).matches
    alone = both.some([1]).look(Gaze(zero[:1], zero[:1], zero[:1]), [torch.Generator().manual_seed(6)]).matches
    assert torch.equal(together.classes[1], alone.classes[0])
    assert together.classes.shape == (2, observer.retina.count, 4)
    assert arenas(LogPolar(600), scenes, None)[1].look(Gaze(zero, zero, zero), both.noise).matches.classes is None


def test_the_judge_counts_the_class_and_nothing_else():
    scene = build_scene(Marked(CANS, marks=3, sought=2), 1, Head())
    observer, arena = arenas(LogPolar(3000), [scene])
    cells = fibonacci_directions(4000)
    memory = new_memory(observer, cells[cells[:, 0] > 0.5])
    truth = truth_of(scene, memory.cells)
    (episode,) = run_episodes(observer, stack([memory]), arena, [truth], [torch.Generator().manual_seed(0)], Rules(12))
    assert bool((episode.reward[~episode.hit] == -6.0).all())
    assert truth.nearest_m == scene.nearest_range_m
    if bool(episode.hit.any()):
        first = int(episode.hit.long().argmax())
        assert float(episode.gap[first]) > 0.9 and float(episode.gap[:first].sum()) == 0


def test_a_resolved_decoy_is_worth_less_than_what_is_unresolved():
    cells = fibonacci_directions(400)
    observer = Observer(classes=CLASSES)
    memory = new_memory(observer, cells[cells[:, 0] > 0.3])
    believed = new_classes(CLASSES, memory.cells)
    told = torch.tensor([[0.02, 0.94, 0.02, 0.02]])
    pairs = Pairs(torch.zeros(1, dtype=torch.int64), torch.tensor([3]))
    step = decide(observer, memory._replace(classes=join_evidence(believed, told, pairs)))
    others = torch.arange(len(memory.cells)) != 3
    assert float(step.reward.mean[3]) < 0.3 * float(step.reward.mean[others].min())


def test_mistakes_are_named(tmp_path, capsys):
    with pytest.raises(SettingError, match=r"scene.sought = 7: expected a class that an object has, 1 to 3"):
        Marked(CANS, marks=3, sought=7)
    scene = build_scene(Marked(CANS, marks=3, sought=2), 1, Head())
    with pytest.raises(SettingError, match=r"reward.sought = 1: expected 2, the class of the scene's target"):
        arenas(LogPolar(100), [scene], Classes(4, 1))
    with pytest.raises(SettingError, match="reward = of_class: expected a scene whose things bear marks"):
        arenas(LogPolar(100), [build_scene(CANS, 1, Head())])
    memory = new_memory(Observer(classes=CLASSES), fibonacci_directions(50))
    with pytest.raises(SettingError, match=r"memory.classes"):
        resample(memory, fibonacci_directions(60), Observer().fusion)
    with pytest.raises(SettingError, match="classes = 3: expected 4"):
        decide(Observer(classes=Classes(3)), memory)
    small = ["search", "family=marked", "episodes=1", "saccades=2", "memory.cells=60", "picture=false"]
    for settings, named in (
        (["reward.sought=9"], "sought = 9: expected a class that an object has, 1 to 3"),
        (["fidelity=photometric"], "reward = of_class: expected motion=still and fidelity=geometric"),
    ):
        assert main([*small, *settings, f"hydra.run.dir={tmp_path}/run"]) == 1
        assert named in capsys.readouterr().err


def test_classes_are_saved_with_the_memory(tmp_path):
    memory = new_memory(Observer(classes=CLASSES), fibonacci_directions(50))
    memory = memory._replace(classes=memory.classes + torch.arange(4))
    save_memory(tmp_path / "m.npz", memory)
    assert torch.equal(load_memory(tmp_path / "m.npz").classes, memory.classes)
