"""What a configuration names: found, trusted, called and checked, or one line under the setting's own name."""

import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from torchfovea.cli import main
from torchfovea.commands.shared.build import build_match, build_motor, build_renderer, build_scene_of, build_sensor
from torchfovea.commands.shared.config import conf_dir
from torchfovea.commands.shared.rewards import build_reward
from torchfovea.commands.shared.strategy import build_strategy
from torchfovea.commands.shared.trust import load_trusted
from torchfovea.imported import load_function, load_object
from torchfovea.perception import Observer
from torchfovea.sensing.head import Head
from torchfovea.setting import SettingError
from torchfovea.sim.scene import AttentionWorld, Room

OWN = """
from collections import namedtuple

nothing = 5

def one(*anything, **settings):
    return 1

def picky(size):
    return size

def nobody():
    return 1

class Can:
    def __init__(self, colour="red"):
        self.colour = colour

    def __call__(self, *anything):
        return self.colour

    def move(self, head, before, command):
        return None

class Dear:
    def __init__(self, price):
        self.price = price
"""

BUILD = {
    "scene": lambda cfg: build_scene_of(cfg, Head(), 0),
    "renderer": build_renderer,
    "motor": lambda cfg: build_motor(cfg)(build_scene_of(configured(), Head(), 0)),
    "sensor": build_sensor,
    "matcher": build_match,
    "acquisition": lambda cfg: build_strategy(cfg, Observer()),
    "reward": build_reward,
}


TINY = [
    "fidelity=geometric", "episodes=1", "saccades=1", "sensor.receptive_fields=200", "memory.cells=60", "picture=false",
]  # fmt: skip


def configured(*overrides: str):
    with initialize_config_dir(conf_dir(), version_base="1.3"):
        return compose("search", overrides=list(overrides))


@pytest.fixture
def own(tmp_path, monkeypatch):
    """A module `own_things` of a user's."""
    (tmp_path / "own_things.py").write_text(OWN)
    monkeypatch.syspath_prepend(str(tmp_path))
    return tmp_path


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("own_things:one", None),
        ("own_things", "thing = own_things: expected package.module:function"),
        (5, "thing = 5: expected package.module:function"),
        (None, "thing = None: expected"),
        ("no_such_module:one", "thing = no_such_module:one: expected a module that can be imported"),
        ("own_things:two", "thing = own_things:two: expected a function two in own_things"),
        ("own_things:nothing", "expected a function nothing in own_things"),
        ("..:one", "expected a module that can be imported"),
    ],
)
def test_a_function_is_found_by_its_name(own, source, message):
    if message is None:
        assert load_function(source, "thing")() == 1
    else:
        with pytest.raises(SettingError, match=message.replace(".", r"\.")):
            load_function(source, "thing")


@pytest.mark.parametrize("target", ["torchfovea.sim.scene.Nothing", "torchfovea.no.such", "torchfovea", "a b", 7, ""])
def test_a_target_that_is_not_there(target):
    with pytest.raises(SettingError, match=r"^thing = .*: expected"):
        load_object(target, "thing")


@pytest.mark.parametrize(
    "target",
    ["os.system", "own_things.one", "torchfovea.cli.os.system", "torchfovea.sim.rays.np.load", "torchfoveal.x"],
)
def test_only_own_code_is_trusted(own, target):
    with pytest.raises(SettingError, match=r"^thing = .*trust=true"):
        load_trusted(target, "thing", False)


def test_trust_lets_any_code_be_named(own):
    assert load_trusted("own_things.one", "thing", True)() == 1
    assert load_trusted("torchfovea.sim.scene.Cans", "thing", False)().cans == 7


@pytest.mark.parametrize("group", sorted(BUILD))
def test_every_group_takes_a_users_own_and_checks_it(own, group):
    choice = "correspondences" if group == "matcher" else "external"
    for source, message in (
        ("null", rf"{group}.source = None: expected package.module:function"),
        ("own_things:two", rf"{group}.source = own_things:two: expected a function"),
        ("gone:two", rf"{group}.source = gone:two: expected a module"),
    ):
        with pytest.raises(SettingError, match=message):
            BUILD[group](configured(f"{group}={choice}", f"{group}.source={source}"))
    for target, message in (
        ("os.getcwd", rf"{group}._target_ = os.getcwd: expected .*trust=true"),
        ("torchfovea.gone", rf"{group}._target_ = torchfovea.gone: expected"),
    ):
        cfg = configured(f"{group}={choice}", f"+{group}._target_={target}")
        with pytest.raises(SettingError, match=message):
            BUILD[group](cfg)


def test_a_scene_file_without_targets_is_still_ours():
    """As `tune` wrote them before scenes named what they are."""
    old = {"scene": {"name": "attention_world", "can_radius_m": 0.08, "room": {"front_m": 4.5}}}
    scene = build_scene_of(OmegaConf.create(old), Head(), 0)
    assert scene.params == AttentionWorld(can_radius_m=0.08, room=Room(front_m=4.5))


@pytest.mark.parametrize("group", ["scene", "motor", "sensor"])
def test_the_wrong_thing_is_named(own, group):
    with pytest.raises(SettingError, match=f"^{group} = int"):
        BUILD[group](configured(f"{group}=external", f"{group}.source=own_things:one"))


@pytest.mark.parametrize(
    ("group", "source", "misfit"),
    [
        ("scene", "nobody", r"\(seed, head\): too many"),
        ("renderer", "nobody", r"\(scene, R, t, camera, size_px\): too many"),
        ("motor", "nobody", r"\(model\): too many"),
        ("sensor", "picky", r"\(\): missing a required argument: 'size'"),
        ("matcher", "nobody", r"\(views, retina, budget\): too many"),
        ("matcher", "Dear", r"\(views, retina, budget\): too many"),
        ("acquisition", "nobody", r"\(view\): too many"),
        ("reward", "nobody", r"\(points\): too many"),
    ],
)
def test_a_function_of_other_arguments_is_refused_before_the_run(own, group, source, misfit):
    choice = "correspondences" if group == "matcher" else "external"
    with pytest.raises(SettingError, match=f"= own_things:{source}: expected a function of {misfit}"):
        BUILD[group](configured(f"{group}={choice}", f"{group}.source=own_things:{source}"))


def test_a_matcher_of_two_images_is_asked_for_its_arguments_too(own):
    with pytest.raises(SettingError, match=r"own_things:nobody: expected a function of \(left, right\)"):
        build_match(configured("matcher=external", "matcher.source=own_things:nobody"))
    network = build_match(configured("matcher=external", "matcher.source=own_things:Can")).source
    assert network("left", "right") == "red"


@pytest.mark.parametrize("group", ["renderer", "matcher", "acquisition", "reward", "motor"])
def test_a_class_that_needs_nothing_is_made(own, group):
    choice = "correspondences" if group == "matcher" else "external"
    made = BUILD[group](configured(f"{group}={choice}", f"{group}.source=own_things:Can"))
    assert getattr(made, "__wrapped__", made).colour == "red"


@pytest.mark.parametrize("group", ["reward", "sensor"])
def test_what_an_observer_has_can_be_hashed(own, group):
    (own / "loose_things.py").write_text(
        "from dataclasses import dataclass\n\n@dataclass\nclass Loose:\n    size: int = 1\n\n"
        "    def __call__(self, points):\n        return points\n\ndef loose():\n    return Loose()\n"
    )
    source = "Loose" if group == "reward" else "loose"
    with pytest.raises(SettingError, match=f"^{group} = Loose: .* hashed, such as a frozen dataclass"):
        BUILD[group](configured(f"{group}=external", f"{group}.source=loose_things:{source}"))


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["scene.name=attention_word"], r"scene.name = attention_word: expected one of attention_world, cans"),
        (
            ["scene.name=cans"],
            r"scene._target_ = torchfovea.sim.scene.AttentionWorld: expected torchfovea.sim.scene.Cans",
        ),
        (["+scene.size=3"], r"scene.size = 3: expected a setting of AttentionWorld: can_radius_m"),
        (["scene.room.front_m=far"], r"scene.room.front_m = far: expected a number"),
        (["scene.can_radius_m=[1]"], r"scene.can_radius_m = \[1\]: expected a number"),
    ],
)
def test_settings_that_the_thing_does_not_take(own, overrides, message):
    with pytest.raises(SettingError, match=message):
        build_scene_of(configured(*overrides), Head(), 0)


@pytest.mark.parametrize(
    ("settings", "message"), [({}, "scene = own_things.picky: .*size"), ({"colour": 1}, "scene.colour = 1")]
)
def test_settings_that_a_users_own_does_not_take(own, settings, message):
    cfg = OmegaConf.create({"scene": {"name": "mine", "_target_": "own_things.picky", **settings}, "trust": True})
    with pytest.raises(SettingError, match=message):
        build_scene_of(cfg, Head(), 0)


@pytest.mark.parametrize("choice", ["acquisition=theirs", "acquisition=ucb,theirs"])
def test_a_file_does_not_say_whom_to_trust(own, tmp_path, capsys, choice):
    conf = tmp_path / "theirs" / "acquisition"
    conf.mkdir(parents=True)
    (conf / "theirs.yaml").write_text(
        "# @package _global_\ntrust: true\nacquisition:\n  name: theirs\n  _target_: own_things.one\n  alpha: 1.0\n"
    )
    sweep = ["--multirun"] if "," in choice else []
    folders = [f"hydra.sweep.dir={tmp_path}/sweep", f"hydra.run.dir={tmp_path}/run"]
    assert main(["search", *sweep, "--config-dir", str(conf.parent), choice, *folders, *TINY]) == 1
    assert "trust = true, in a file: expected it among the command's own settings" in capsys.readouterr().err


@pytest.mark.parametrize("choice", ["acquisition=theirs", "acquisition=ucb,theirs", "acquisition=glob(th*)"])
def test_what_a_sweep_chooses_is_read_too(own, tmp_path, capsys, choice):
    conf = tmp_path / "theirs" / "acquisition"
    conf.mkdir(parents=True)
    (conf / "theirs.yaml").write_text(
        "# @package _global_\nhydra:\n  job_logging:\n    formatters:\n      simple:\n        (): os.getcwd\n"
    )
    sweep = [] if choice.endswith("=theirs") else ["--multirun"]
    folders = [f"hydra.sweep.dir={tmp_path}/sweep", f"hydra.run.dir={tmp_path}/run"]
    assert main(["search", *sweep, "--config-dir", str(conf.parent), choice, *folders, *TINY]) == 1
    assert "hydra.job_logging.formatters.simple.() = os.getcwd" in capsys.readouterr().err


@pytest.mark.parametrize("trusted", [False, True])
def test_a_strangers_folder_runs_nothing_without_trust(own, tmp_path, capsys, trusted):
    conf = tmp_path / "theirs" / "acquisition"
    conf.mkdir(parents=True)
    (tmp_path / "callback_of_theirs.py").write_text(
        "from pathlib import Path\n\n\ndef make(path):\n    Path(path).write_text('ran')\n    return object()\n"
    )
    ran = tmp_path / "ran"
    (conf / "theirs.yaml").write_text(
        "# @package _global_\nhydra:\n  callbacks:\n    theirs:\n"
        f"      _target_: callback_of_theirs.make\n      path: {ran}\nacquisition:\n  name: ucb\n  alpha: 1.0\n"
        "  _target_: torchfovea.commands.shared.strategy.ucb\n"
    )
    command = ["search", "--config-dir", str(conf.parent), "acquisition=theirs", *TINY, f"hydra.run.dir={tmp_path}/run"]
    if trusted:
        with pytest.warns(UserWarning, match="Callback object"):  # an object has none of a callback's parts
            assert main([*command, "trust=true"]) == 0
        assert ran.exists()
    else:
        assert main(command) == 1
        said = capsys.readouterr().err.strip().splitlines()
        assert len(said) == 1 and "hydra.callbacks.theirs._target_ = callback_of_theirs.make" in said[0]
        assert not ran.exists() and not (tmp_path / "run").exists()
