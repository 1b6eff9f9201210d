"""The environments: Gymnasium's own checks, rows like single searches, and the same course and metrics as a search."""

import math

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import torchfovea.envs  # noqa: F401 registers the environment
from torchfovea.cli import main
from torchfovea.envs.actions import action_mask
from torchfovea.envs.adapter import policy_strategy
from torchfovea.envs.judging import EPISODE_METRICS
from torchfovea.envs.settings import EnvSettings, env_settings
from torchfovea.episode import Rules, run_episode
from torchfovea.perception import new_memory
from torchfovea.search import search
from torchfovea.setting import SettingError
from torchfovea.sim.arena import SimulatedArena
from torchfovea.sim.arenas import GeometricArenas
from torchfovea.sim.scene import Cans, build_scene
from torchfovea.sim.world import World

NAME = "torchfovea/VisualSearch-v0"
TINY = {
    "overrides": ("sensor.receptive_fields=300", "memory.cells=80"), "scenes": (0, 1), "saccades": 4,
    "map_shape": (4, 6),
}  # fmt: skip


def single(**settings):
    return gymnasium.make(NAME, **{**TINY, **settings}).unwrapped


def vector(count, **settings):
    return gymnasium.make_vec(
        NAME, num_envs=count, vectorization_mode="vector_entry_point", **{**TINY, **settings}
    )  # fmt: skip


@pytest.mark.parametrize(
    "settings",
    [
        {"observe": ("memory", "gaze", "gaussians")},
        {"action": "cell", "naming": True, "fidelity": "cells"},
        {"action": "weights", "fidelity": "cells", "information": 0.1, "degrees": 0.01, "found": 1.0},
        {"naming": True, "overrides": (*TINY["overrides"], "stop.probability=0.01")},
    ],
)
def test_gymnasium_has_nothing_to_say(settings):
    check_env(single(**settings), skip_render_check="observe" not in settings)


def test_images_are_seen_as_a_cortical_image():
    overrides = (*TINY["overrides"], "sensor.source_px=60")
    env = single(fidelity="photometric", observe=("retina", "gaussians"), overrides=overrides, saccades=3)
    seen, _ = env.reset(seed=0)
    assert seen in env.observation_space
    assert seen["retina"].std() > 0.05
    again, *_ = env.step(np.zeros(2, np.float32))
    assert again in env.observation_space and not np.array_equal(seen["retina"], again["retina"])


@pytest.mark.parametrize("matcher", ["sgbm", "sweep"])
def test_rows_that_are_drawn_together_see_what_one_sees(matcher):
    overrides = (*TINY["overrides"], "sensor.source_px=60", f"matcher={matcher}")
    settings = {"fidelity": "photometric", "overrides": overrides, "saccades": 3}
    settings |= {"observe": ("retina", "memory")}
    together, alone = vector(2, **settings), single(**settings)
    together.reset(seed=5)
    alone.reset(seed=6)
    action = np.float32([[0.1, 0.2], [-0.3, 0.1]])
    seen, own = together.step(action)[0], alone.step(action[1])[0]
    np.testing.assert_allclose(seen["retina"][1], own["retina"], atol=1e-3)
    assert np.median(np.abs(seen["memory"][1] - own["memory"])) < 1e-4


@pytest.mark.parametrize("fidelity", ["geometric", "cells"])
@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
def test_a_row_is_the_single_environment_with_its_seed(fidelity, mode):
    settings = {"fidelity": fidelity, "information": 0.1, "degrees": 0.01, "naming": True}
    together, alone = vector(3, autoreset_mode=mode, **settings), [single(**settings) for _ in range(3)]
    assert together.metadata["autoreset_mode"] is AutoresetMode(mode)
    first, _ = together.reset(seed=5)
    for b, env in enumerate(alone):
        seen, _ = env.reset(seed=5 + b)
        np.testing.assert_allclose(first["memory"][b], seen["memory"], atol=1e-5)
    over, ends, names = [False] * 3, 0, np.random.default_rng(0)
    for _ in range(9):
        action = np.concatenate([names.uniform(-1, 1, (3, 2)), names.uniform(-1, 0.4, (3, 1))], 1).astype(np.float32)
        seen, reward, terminated, truncated, info = together.step(action)
        assert seen in together.observation_space
        for b, env in enumerate(alone):
            if mode == "NextStep" and over[b]:
                own, more = env.reset()
                over[b], expected = False, (0.0, False, False)
            else:
                own, *expected, more = env.step(action[b])
                ended = expected[1] or expected[2]
                over[b], ends = ended, ends + ended
                where = info if mode == "NextStep" else info.get("final_info", {})
                for name, value in more.get("metrics", {}).items():
                    assert where["metrics"][name][b] == pytest.approx(value, abs=1e-5)
                    assert where["_metrics"][b] and where["metrics"][f"_{name}"][b]
                if ended and mode == "SameStep":
                    np.testing.assert_allclose(info["final_obs"][b]["memory"], own["memory"], atol=1e-5)
                    own, more = env.reset()
            assert [reward[b], terminated[b], truncated[b]] == pytest.approx(list(expected), abs=1e-5)
            for name in own:
                np.testing.assert_allclose(seen[name][b], own[name], atol=1e-5)
            assert info["gap"][b] == pytest.approx(more["gap"], abs=1e-5) and info["_gap"][b]
    assert ends >= 6


class Still:
    """A simulated robot whose noise depends on how often it has looked, and on nothing else."""

    def __init__(self, observer):
        scene = build_scene(Cans(), 3, observer.head)
        self.arena = SimulatedArena(World(scene, camera=observer.camera), observer, None)
        self.saccade, self.fixation, self.truth = self.arena.saccade, self.arena.fixation, self.arena.truth
        self.count = 0

    def look(self, gaze, generator):
        self.count += 1
        return self.arena.look(gaze, torch.Generator().manual_seed(self.count))


def nearest(seen):
    """A policy: toward the nearest that the map shows as eligible, counted from the left and the top."""
    shown = np.where(seen["memory"][:, 3] > 0, seen["memory"][:, 0], 0)
    at = shown.reshape(len(shown), -1).argmax(-1)
    rows, columns = shown.shape[1:]
    return np.stack([1 - (at % columns + 0.5) / columns * 2, (at // columns + 0.5) / rows * 2 - 1], -1)


@pytest.mark.parametrize("action", ["cell", "weights"])
def test_the_environment_and_a_search_take_the_same_course(action):
    shape = TINY["map_shape"]

    def policy(seen):
        if action == "weights":
            return np.tile(np.float32([0.9, 0.3, 0.0, 0.2]), (len(seen["gaze"]), 1))
        return (np.round(nearest(seen)[:, 0] * 30).astype(int) * 7) % 80  # some cell, out of reach or not

    observer = single().rows.observer
    env = single(robot=Still(observer), action=action)
    seen, info = env.reset(seed=0)
    gazes = []
    for _ in range(3):
        step = policy({name: value[None] for name, value in seen.items()})[0]
        if action == "cell":
            eligible = np.flatnonzero(info["action_mask"])
            cells = env.rows.cells.numpy()
            step = int(eligible[(cells[eligible] @ cells[step]).argmax()])
        seen, *_, info = env.step(step)
        gazes.append([float(angle[0]) for angle in env.rows.gaze])
    memory = new_memory(observer, env.rows.cells)
    strategy = policy_strategy(policy, observer, action, shape)
    robot = Still(observer)
    course = [[float(a) for a in g.move.gaze] for g in search(robot, observer, memory, 4, None, strategy)]
    np.testing.assert_allclose(gazes, course[1:], atol=1e-5)
    truth, judged = robot.truth(memory.cells), Still(observer)
    rules = Rules(4, policy_strategy(policy, observer, action, shape))
    episode = run_episode(observer, memory, judged, truth, torch.Generator(), rules)
    metrics = info["metrics"]
    expected = {
        "gap_final": float(episode.gap[-1]), "gap_per_saccade": float(episode.gap.mean()),
        "regret_per_saccade": float(episode.regret.mean()), "saccades_to_target": episode.moves,
        "global_information_per_saccade": float(episode.global_information.mean()), "found": float(episode.hit.any()),
        "degrees_travelled": episode.degrees, "motor_seconds": episode.motor_seconds,
        "target_error_m": episode.target_error_m,
    }  # fmt: skip
    assert episode.local_information is not None
    expected["local_information_per_saccade"] = float(episode.local_information.mean())
    assert {name: metrics[name] for name in expected} == pytest.approx(expected, rel=1e-4)
    assert set(metrics) <= set(EPISODE_METRICS)


def test_a_fixation_turns_there_as_far_as_the_head_does():
    env = single()
    env.reset(seed=1)
    head = env.rows.observer.head
    env.step(np.float32([1, -1]))
    assert math.degrees(env.rows.gaze.pan[0]) == pytest.approx(head.pan_limit_deg)
    assert math.degrees(env.rows.gaze.tilt[0]) == pytest.approx(-head.tilt_up_deg)
    env.step(np.float32([-0.5, 0.5]))
    assert math.degrees(env.rows.gaze.pan[0]) == pytest.approx(-0.5 * head.pan_limit_deg)
    assert math.degrees(env.rows.gaze.tilt[0]) == pytest.approx(0.5 * head.tilt_down_deg)
    assert action_mask(env.rows, [0]).shape == (1, 80)


def test_naming_and_the_stop_rule_turn_to_the_best_and_end():
    env = single(naming=True)
    env.reset(seed=0)
    step, looks = env.rows.step, env.rows.looks[0]
    best = torch.where(step.eligible, step.reward.mean, -torch.inf)[0].argmax()
    _, reward, terminated, truncated, info = env.step(np.float32([0, 0, 1]))
    assert (terminated, truncated) == (True, False) and env.rows.looks[0] is looks
    assert torch.stack(env.rows.gaze)[:, 0].tolist() == pytest.approx(
        torch.stack(env.rows.aims())[:, 0, best].tolist(), abs=1e-5
    )
    assert reward == pytest.approx(info["metrics"]["gap_final"])
    with pytest.raises(SettingError, match=r"step = no episode: expected reset"):
        env.step(np.float32([0, 0, 1]))
    sure = single(overrides=(*TINY["overrides"], "stop.probability=0.99", "stop.tolerance=9"))
    sure.reset(seed=0)
    assert sure.step(np.zeros(2, np.float32))[2:4] == (True, False)


def test_cells_are_known_as_well_as_they_claim():
    env = vector(24, fidelity="cells", overrides=("memory.cells=300",))
    env.reset(seed=0)
    env.step(np.tile(np.float32([0.3, 0.4]), (24, 1)))
    rows = env.rows
    true = torch.stack([rows.places.truth(b).cell_points.norm(dim=-1) for b in range(24)])
    vector_part, matrix = rows.memory.information
    error = vector_part[..., 2] / matrix[..., 5] - 1 / true
    z = (error * matrix[..., 5].sqrt())[(rows.memory.looks > 0) & torch.isfinite(true)]
    assert len(z) > 2000
    assert float(z.square().mean()) == pytest.approx(1, abs=0.1)


def test_rows_of_arenas_are_arenas():
    observer = single().rows.observer
    scenes = [build_scene(Cans(), seed, observer.head) for seed in (0, 1, 2)]
    arenas = GeometricArenas([scenes[0], scenes[0], scenes[1]], observer)
    arenas.renew([1], [scenes[2]], [7])
    fresh = GeometricArenas([scenes[1], scenes[2]], observer)
    gaze = type(env_gaze := single().rows.gaze)(*(torch.tensor([0.2, -0.3]).to(a.dtype) for a in env_gaze))
    part = arenas.some([2, 1])
    moved, expected = part.saccade(gaze), fresh.saccade(gaze)
    assert torch.equal(moved.degrees, expected.degrees)
    assert torch.equal(arenas.before[[2, 1]], fresh.before) and not arenas.before[0].any()
    for a, b in zip(part.fixation(gaze), fresh.fixation(gaze), strict=True):
        assert torch.equal(a, b)
    looks = [p.look(gaze, [torch.Generator().manual_seed(k) for k in (3, 4)]).matches for p in (part, fresh)]
    assert torch.equal(looks[0].left_px, looks[1].left_px) and torch.equal(looks[0].valid, looks[1].valid)


def test_only_some_rows_may_be_reset():
    env = vector(2, fidelity="cells")
    env.reset(seed=0)
    env.step(np.zeros((2, 2), np.float32))
    env.reset(options={"reset_mask": np.array([False, True])})
    assert env.rows.time.tolist() == [1, 0]
    with pytest.raises(SettingError, match=r"options\.reset_mask"):
        env.reset(options={"reset_mask": np.array([False, False])})


def test_pictures():
    env = vector(2, render_mode="rgb_array", fidelity="cells")
    env.reset(seed=0)
    pictures = env.render()
    assert len(pictures) == 2 and pictures[0].dtype == np.uint8
    assert pictures[0].shape == (3 * 4 * 12 + 4, 6 * 12, 3) and pictures[0].std() > 0


@pytest.mark.parametrize(
    ("action", "complaint"),
    [
        ([0.0, 1.5], r"action = values from 0 to 1\.5: expected an element of \[-1, 1\]"),
        ([0.0, math.nan], "action = NaN or infinite"),
        ([0.0, 0.0, 0.0], r"action\.shape = \(3,\): expected \(2,\)"),
        (["left", "up"], "action = an array of"),
        (None, "action = an array of object"),
    ],
)
def test_actions_that_are_none(action, complaint):
    env = single(fidelity="cells")
    env.reset(seed=0)
    with pytest.raises(SettingError, match=complaint):
        env.step(action)


def test_one_row_s_bad_action_is_refused_before_any_row_moves():
    env = vector(3, fidelity="cells")
    with pytest.raises(SettingError, match=r"step = no episode"):
        env.step(np.zeros((3, 2), np.float32))
    env.reset(seed=0)
    for value in (math.nan, math.inf, -1.5):
        actions = np.zeros((3, 2), np.float32)
        actions[1, 0] = value
        with pytest.raises(SettingError, match=r"action = "):
            env.step(actions)
    with pytest.raises(SettingError, match=r"action\.shape = \(2, 2\): expected \(3, 2\)"):
        env.step(np.zeros((2, 2), np.float32))
    cells = vector(2, fidelity="cells", action="cell")
    cells.reset(seed=0)
    for bad, complaint in (([0, 80], r"values from 0 to 80: expected an element of 0 to 79"), ([0.5, 1], "float64")):
        with pytest.raises(SettingError, match=complaint):
            cells.step(np.array(bad))
    assert env.rows.time.tolist() == [0, 0, 0] and cells.rows.time.tolist() == [0, 0]


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({"fidelity": "good"}, "fidelity = good: expected one of geometric"),
        ({"observe": ("retina",)}, "observe = retina: expected fidelity=photometric"),
        ({"saccades": 1}, "saccades = 1: expected at least 2"),
        ({"scenes": []}, "scenes = "),
        ({"reward": 2}, "reward = 2: expected a setting of the environment"),
        ({"gap": math.nan}, "gap = nan: expected a number"),
        ({"gap": math.inf}, "gap = inf: expected a finite weight"),
        ({"action": "turn"}, "action = turn"),
    ],
)
def test_settings_that_are_none(settings, complaint):
    with pytest.raises(SettingError, match=complaint):
        env_settings(settings)
    assert env_settings({"scenes": range(3)}) == EnvSettings(scenes=(0, 1, 2))


def test_a_policy_searches_from_the_command_line(tmp_path, monkeypatch, capsys):
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "mine_of_envs.py").write_text(
        "import numpy as np\n\ndef look(seen):\n    return 0 * seen['gaze'][:, :2]\n"
    )
    small = ["fidelity=geometric", "episodes=1", "saccades=3", "sensor.receptive_fields=300", "memory.cells=80"]
    run = ["search", "acquisition=trained", *small, "picture=false"]
    assert main([*run, "acquisition.policy=mine_of_envs:look", f"hydra.run.dir={tmp_path}/run"]) == 0
    assert (tmp_path / "run" / "result.json").exists()
    assert main([*run, f"acquisition.policy={tmp_path}/none.zip", f"hydra.run.dir={tmp_path}/other"]) == 1
    assert "acquisition.policy = " in capsys.readouterr().err
