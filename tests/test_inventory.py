"""The public names: each resolves, the front door's are these, and none means two things by accident."""

import ast
import importlib
import os
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import pytest

import torchfovea
from torchfovea.cli import COMMANDS

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "torchfovea"
FILES = sorted(path for path in PACKAGE.rglob("*.py") if path.name not in ("__init__.py", "__main__.py"))
# what a user calls with parameters of his own, rather than with a configuration
CORE = ("sensing", "stereo", "memory", "deciding", "perception.py", "search.py", "episode.py")
MOST_PARAMETERS = 7

FRONT_DOOR = [
    "BrownConrady",
    "Budget",
    "Correspondences",
    "DirectionMixture",
    "Eligibility",
    "Eyes",
    "Fisheye",
    "Fusion",
    "Gaussian",
    "Gaze",
    "Head",
    "Information",
    "KannalaBrandt",
    "LogPolar",
    "Memory",
    "Motion",
    "Observations",
    "Observer",
    "Pinhole",
    "Prior",
    "SettingError",
    "SigmaPoints",
    "Uniform",
    "belief",
    "cartesian_belief",
    "choose",
    "compiled",
    "cortical",
    "cyclopean",
    "decide",
    "direction_mixture",
    "expected_improvement",
    "eyes",
    "fixate",
    "forget",
    "fovea",
    "interpolate",
    "load_memory",
    "log_density",
    "log_expected_improvement",
    "motion",
    "move",
    "new_memory",
    "observe",
    "perceive",
    "place_features",
    "reconstruct",
    "remember",
    "resample",
    "sample",
    "save_memory",
    "triangulate",
    "unscented_transform",
    "upper_confidence_bound",
    "wrap_around",
]

# Names that two modules define on purpose: which modules, by reason.
ON_NUMBERS_AND_ON_A_VIEW = {"deciding.acquisition", "deciding.strategies"}  # one formula, its callers differ
FROM_SETTINGS = {"deciding.strategies", "commands.shared.strategy"}  # the latter checks settings and returns the former
PEER = "commands.bench.peers"  # what others would write for the function of that name, to be timed against it
TWICE = {
    "expected_improvement": ON_NUMBERS_AND_ON_A_VIEW,
    "log_expected_improvement": ON_NUMBERS_AND_ON_A_VIEW,
    "probability_of_improvement": ON_NUMBERS_AND_ON_A_VIEW,
    "thompson": ON_NUMBERS_AND_ON_A_VIEW,
    "upper_confidence_bound": ON_NUMBERS_AND_ON_A_VIEW,
    "information_gain": {"deciding.infomax", "deciding.strategies"},  # as above
    "hedge": FROM_SETTINGS,
    "oracle": FROM_SETTINGS,
    "raster": FROM_SETTINGS,
    "weighted": FROM_SETTINGS,
    "nearest_to": {"deciding.reward", "commands.shared.rewards"},  # as above, for rewards
    "decide": {"perception", PEER},
    "unscented": {"studies.propagation", PEER},
    "Seen": {"sim.world", PEER},  # its like, without torch
    "render": {"sim.rays", "sim.gl"},  # two renderers, one protocol
    "run": {
        command.target.removeprefix("torchfovea.").removesuffix(":run") for command in COMMANDS.values()
    },  # each command's door
    "cast": {"sim.rays", "memory.voting"},  # a ray, and a vote
    "coverage": {"metrics", "tuning.estimators"},  # estimators bear the names that `tune` knows them by
    "covered": {"sensing.retina", "tuning.estimators"},
}


def name_of(path):
    return ".".join(path.relative_to(PACKAGE).with_suffix("").parts)


def defined_in(tree):
    """The names that a module's own statements bind, imports apart."""
    for node in tree.body:
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.name
        elif isinstance(node, ast.Assign | ast.AnnAssign):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            yield from (name.id for t in targets for name in ast.walk(t) if isinstance(name, ast.Name))


def public_names(tree):
    """What __all__ lists; None without one."""
    for node in tree.body:
        if isinstance(node, ast.Assign) and [getattr(t, "id", None) for t in node.targets] == ["__all__"]:
            return ast.literal_eval(node.value)
    return None


def parameters(function):
    given = function.args
    several = [given.vararg, given.kwarg]
    return len(given.posonlyargs + given.args + given.kwonlyargs) + sum(a is not None for a in several)


def test_the_front_door():
    assert sorted(FRONT_DOOR) == FRONT_DOOR
    assert torchfovea.__all__ == FRONT_DOOR
    assert all(hasattr(torchfovea, name) for name in FRONT_DOOR)
    assert all(getattr(torchfovea, name).__doc__ for name in FRONT_DOOR)


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_public_names_resolve(path):
    names = public_names(ast.parse(path.read_text(encoding="utf-8")))
    assert names is not None, "a module says what is public"
    assert len(set(names)) == len(names)
    module = importlib.import_module(f"torchfovea.{name_of(path)}")
    missing = [name for name in names if not hasattr(module, name)]
    assert not missing, f"__all__ lists what is not there: {missing}"
    assert not [name for name in names if name.startswith("_")]


def test_a_name_means_one_thing():
    where = defaultdict(set)
    for path in FILES:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for name in set(public_names(tree) or ()) & set(defined_in(tree)):
            where[name].add(name_of(path))
    assert {name: modules for name, modules in where.items() if len(modules) > 1} == TWICE


def test_signatures_of_the_core_are_short():
    paths = [path for path in FILES if path.relative_to(PACKAGE).parts[0] in CORE]
    assert {path.relative_to(PACKAGE).parts[0] for path in paths} == set(CORE)
    long = {
        f"{name_of(path)}.{node.name}": parameters(node)
        for path in paths
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and parameters(node) > MOST_PARAMETERS
    }
    assert not long


@pytest.mark.parametrize(("given", "policy"), [(None, "PASSIVE"), ("ACTIVE", "ACTIVE")])
def test_threads_do_not_spin_while_they_wait(given, policy):
    """OpenMP reads it when PyTorch is loaded, which must not be before; what is set already stays."""
    told = "import os, sys; sys.modules['torch'] = None\ntry:\n    import torchfovea\nexcept ImportError:\n    "
    told += "print(os.environ['OMP_WAIT_POLICY'])"
    others = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    environment = others if given is None else {**others, "OMP_WAIT_POLICY": given}
    done = subprocess.run([sys.executable, "-c", told], capture_output=True, text=True, env=environment, timeout=60)
    assert done.stdout.strip() == policy, done.stderr
