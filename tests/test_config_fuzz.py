"""Every setting of every command, overridden by what it cannot be: one line says so, at once, before any work.

How we know that work has begun: a command asks for its folder (`run_folder`) when every setting has been read and all
that it needs has been built once, and writes nothing before. Here that function raises `Begun` instead, so that a
refused override costs milliseconds and an accepted one is told from it. What is run is the command line's own job, on
a configuration that is composed once for a command; `tests/test_settings.py` goes through the whole command line.

`scripts/fuzz.sh` tries every override and every option of every group, the suite a sample of them.

Accepted, because nobody is misled: a name of one's own for a bias or a distribution (`memory.name=abc`), a number of
the right kind but out of range where the command does not read it (`UNREAD`), and whatever is of the right kind in a
profile of `reproduce` that is not chosen.
"""

import contextlib
import copy
import importlib
import io
import os
import random
import shutil
import sys
import time
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, ListConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from torchfovea import cli
from torchfovea.commands import doctor
from torchfovea.commands.shared.config import conf_dir
from torchfovea.commands.shared.kinds import BESIDES, kinds_of
from torchfovea.commands.table import COMMANDS

OVERRIDES = int(os.environ.get("FUZZ_OVERRIDES", "12"))  # of each command; 0: all
OPTIONS = int(os.environ.get("FUZZ_OPTIONS", "8"))  # of groups; 0: all
SLOWEST_S = 5.0  # of CPU
ELSEWHERE = ["{a: 1}", "nan", "''"]  # of no kind that a setting has, or of no value
WRONG = {
    bool: [*ELSEWHERE, "[1, 2]", "abc", "0.5", "-1", "null"],
    int: [*ELSEWHERE, "[1, 2]", "abc", "0.5", "-1", "true"],
    float: [*ELSEWHERE, "[1, 2]", "abc", "-1", "true"],
    str: [*ELSEWHERE, "[1, 2]", "abc", "0.5", "-1", "true"],
    list: [*ELSEWHERE, "abc", "0.5", "-1", "true", "null"],
    dict: ["abc", "nan", "''", "0.5", "-1", "true"],
    type(None): [*ELSEWHERE, "true"],
}
# numbers that may be below 0
SIGNED = {
    "head.eyes_forward_m", "head.eyes_up_m", "head.ego_height_m", "eligibility.ground_z_m", "matcher.left_right_px",
    "matcher.correlation", "scene.margin_m", "acquisition.by_time", "acquisition.by_unseen", "acquisition.improvement",
    "acquisition.information", "acquisition.doubt", "acquisition.cost_per_deg",
}  # fmt: skip
# what a command shares with others, and does not read: (command, setting)
UNREAD = {(command, "seed") for command in ("sense", "benchmark", "doctor", "collect")}
OWN_NAMES = {"memory.name", "distribution.name"}
# whose kind only who reads them knows: functions, files and networks of others
FREE = {
    "dir", "acquisition.source", "acquisition.policy", "acquisition.action", "acquisition.map_shape", "head.source",
    "matcher.invalid", "matcher.model", "matcher.source.model", "matcher.source.tells", "matcher.source.size_px",
    "motor.source", "renderer.source", "reward.source", "reward.point", "scene.source", "sensor.source",
    "profiles.quick.sample", "profiles.paper.sample",
}  # fmt: skip
# options that need what only a user has
NEEDS = {"external", "trained", "correspondences", "onnx", "onnx_foundation_stereo", "onnx_igev", "onnx_raft_stereo",
         "onnx_s2m2", "nearest_to", "every_pixel"}  # fmt: skip


class Begun(BaseException):
    """A command has read everything, and would begin."""


def begin(*_):
    """In place of a command's folder."""
    raise Begun


@pytest.fixture(scope="module")
def places(tmp_path_factory):
    """A folder for runs, and what some commands need to begin at all."""
    place = tmp_path_factory.mktemp("fuzz")
    small = "episodes=1 saccades=2 sensor.receptive_fields=400 sensor.source_px=64 memory.cells=60 picture=false"
    assert cli.main(["search", *small.split(), "record=true", f"hydra.run.dir={place / 'made' / 'search'}"]) == 0
    needed = {
        "replay": [f"recording={place / 'made' / 'search' / 'recording'}"],
        "sense": ["pair=motorcycle"],
        "collect": [f"dir={place / 'made'}"],
    }
    return place / "run", needed


@pytest.fixture(autouse=True)
def sentinel(monkeypatch):
    """Commands that stop where their work begins."""
    monkeypatch.delenv("HYDRA_FULL_ERROR", raising=False)
    monkeypatch.setattr(HydraConfig.instance(), "cfg", None)
    for command in COMMANDS.values():
        importlib.import_module(command.target.partition(":")[0])
    for name, module in list(sys.modules.items()):
        # of all that ask for it: not of shared.config itself, whose own the command line asks for
        if name.startswith("torchfovea.commands.") and hasattr(module, "run_folder") and not name.endswith(".config"):
            monkeypatch.setattr(module, "run_folder", begin)
    monkeypatch.setattr(doctor, "_probe", begin)  # whose only work is to look
    with initialize_config_dir(conf_dir(), version_base="1.3"):
        yield
    assert not GlobalHydra.instance().is_initialized()


def composed(command, places, *more):
    """A command's configuration as Hydra gives it to a job."""
    run, needed = places
    cfg = compose(command, overrides=[*needed.get(command, []), *more], return_hydra_config=True)
    with open_dict(cfg):
        cfg.hydra.runtime.output_dir = str(run)
        cfg.hydra.job.name = cfg.hydra.job.config_name = command
        cfg.hydra.mode = "RUN"
    return cfg


def attempt(command, whole, override, run):
    """What came of an override, what was said on stderr, and the CPU time of it; the folder is gone again."""
    cfg, said, since = copy.deepcopy(whole), io.StringIO(), time.process_time()
    run.mkdir(parents=True)
    if override is not None:
        parsed = OverridesParser.create().parse_override(override)
        with open_dict(cfg):
            cfg.hydra.overrides.task = [override]
        try:
            OmegaConf.update(cfg, parsed.key_or_group, parsed.value(), merge=True)
        except OmegaConfBaseException as error:  # Hydra refuses it, and the command line says so
            run.rmdir()
            return "refused", f"{override}: expected {error}".splitlines()[0], 0.0
    HydraConfig.instance().set_config(cfg)
    with open_dict(task := copy.copy(cfg)):
        del task["hydra"]
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
        try:
            cli._job(command, [override or ""], False)(task)
            outcome = "done"
        except Begun:
            outcome = "begun"
            shutil.rmtree(run)
        except SystemExit as stop:
            outcome = "refused" if stop.code == 1 else f"status {stop.code}"
    # what a budget was made for is a remark, and no error
    lines = [line for line in said.getvalue().splitlines() if not line.startswith(("the budget was", "budget = auto"))]
    return outcome, "\n".join(lines), time.process_time() - since


def settings_of(cfg, group=""):
    """Every setting and its value, or those of a group."""
    for key in cfg:
        node, name = cfg._get_node(key), f"{group}{key}"
        if name == "hydra" or " " in name:
            continue
        inside = isinstance(node, DictConfig) and not node._is_none()
        # a group's own name chooses another option
        if not (inside and (Path(conf_dir()) / name).is_dir()):
            yield name, {} if inside else [] if isinstance(node, ListConfig) else cfg[key]
        if inside:
            yield from settings_of(node, f"{name}.")


def wrong_ones(command, name, value):
    """What a setting cannot be, by the value that it has."""
    for text in WRONG[type(value)]:
        fine = text == "-1" and (name in SIGNED or (command, name) in UNREAD)
        fine |= text in ("-1", "abc") and name.startswith(("profiles.quick.", "profiles.paper."))
        # what only its readers judge, what a fit noted, no entry of one's own and no mixture beside a topology
        fine |= name in FREE or name.startswith("budget.made_for.")
        fine |= text == "null" and name in ("mine", "memory.weights", "memory.means", "memory.covariances")
        if not fine and not (text == "abc" and name in OWN_NAMES):
            yield f"{name}={text}"


def complaint(override, outcome, said, seconds, run):
    """What is wrong with the answer to an override that cannot be; empty: nothing."""
    name = override.partition("=")[0].rpartition(".")[2]
    # a head that reaches nothing is named by what it cannot reach
    known = name in said or "region in which" in said or "reachable" in said
    if outcome != "refused":
        return f"{outcome} {said}".strip()
    if not (known and "expected" in said and len(said.splitlines()) == 1):
        return f"said {said!r}"
    return f"leaves {run}" if run.exists() else f"{seconds:.1f} s" if seconds >= SLOWEST_S else ""


def check(command, whole, overrides, run):
    """Every override is refused in one line that names it, in time, and leaves no folder; the slowest of them."""
    slowest, complaints = 0.0, []
    for override in overrides:
        outcome, said, seconds = attempt(command, whole, override, run)
        if wrong := complaint(override, outcome, said, seconds, run):
            complaints.append(f"{command} {override}: {wrong}")
            shutil.rmtree(run, ignore_errors=True)
        slowest = max(slowest, seconds)
    assert not complaints, "\n".join([f"{len(complaints)} of {len(overrides)}", *complaints])
    return slowest


@pytest.mark.parametrize("command", COMMANDS)
def test_what_a_setting_cannot_be_is_one_line_before_any_work(command, places, capsys):
    whole, run = composed(command, places), places[0]
    assert attempt(command, whole, None, run)[0] == "begun"
    overrides = [o for name, value in settings_of(whole) for o in wrong_ones(command, name, value)]
    tried = random.Random(command).sample(overrides, min(OVERRIDES, len(overrides))) if OVERRIDES else overrides
    slowest = check(command, whole, tried, run)
    if not OVERRIDES:
        with capsys.disabled():
            print(f"\n{command}: {len(tried)} overrides refused, the slowest in {slowest:.2f} s of CPU")


def options():
    """Every option of every group, with a command that has the group."""
    for folder in sorted(path for path in Path(conf_dir()).iterdir() if path.is_dir()):
        first = next(c for c in COMMANDS if f"- {folder.name}:" in (Path(conf_dir()) / f"{c}.yaml").read_text())
        yield from ((first, folder.name, path.stem) for path in sorted(folder.glob("*.yaml")))


CHOSEN = random.Random(0).sample(list(options()), OPTIONS) if OPTIONS else list(options())


@pytest.mark.parametrize(("command", "group", "option"), CHOSEN, ids=str)
def test_every_option_composes_and_begins_and_its_settings_refuse(command, group, option, places, capsys):
    more = [f"{group}={option}"]
    more += ["family=marked"] if option in ("marked", "of_class") and group != "family" else []
    whole, run = composed(command, places, *more), places[0]
    outcome, said, seconds = attempt(command, whole, None, run)
    assert outcome == ("refused" if option in NEEDS else "begun"), said
    assert seconds < SLOWEST_S
    if outcome == "begun" and group in whole:
        inside = OmegaConf.select(whole, group)
        overrides = [o for name, value in settings_of(inside, f"{group}.") for o in wrong_ones(command, name, value)]
        tried = random.Random(option).sample(overrides, min(2, len(overrides))) if OVERRIDES else overrides
        slowest = check(command, whole, tried, run)
        if not OVERRIDES:
            with capsys.disabled():
                print(f"\n{group}={option}: {len(tried)} overrides refused, the slowest in {slowest:.2f} s of CPU")


@pytest.mark.parametrize("command", COMMANDS)
def test_every_setting_has_a_kind(command):
    kinds = kinds_of(command)
    unknown = {name for name, kind in kinds.items() if not kind.names - {"null"} and name not in FREE}
    assert not {name for name in unknown if not name.startswith("budget.made_for.")}


def test_what_is_told_besides_belongs_to_a_setting():
    named = {name for names in BESIDES.values() for name in names.split()}
    assert named <= {name for command in COMMANDS for name in kinds_of(command)}
