"""Settings in Python are judged as those of a configuration are: what is of another type is one line that names it."""

import dataclasses
import importlib
import math
import pkgutil
import re

import pytest
import torch

import torchfovea
from torchfovea.deciding.weighted import Weighting
from torchfovea.search import Look, Move, search
from torchfovea.sensing.camera import Fisheye, Pinhole
from torchfovea.sensing.lens import BrownConrady, KannalaBrandt
from torchfovea.setting import SettingError, check_types, typed
from torchfovea.stereo.onnx_model import OnnxModel

VALUES = (None, "abc", math.nan, math.inf, -1, 0, 0.5, [1, 2], (), {}, True, 10**400, object())
LENS = {"fx_px": 20.0, "fy_px": 20.0, "cx_px": 0.0, "cy_px": 0.0}
NEEDED = {Pinhole: {"focal_px": 30.0}, Fisheye: {"focal_px": 30.0}, BrownConrady: LENS, KannalaBrandt: LENS}
PLAIN = {"float": (int, float), "int": int, "bool": bool, "str": str}
# told by its own words: a file that must be there
ELSEWHERE = {OnnxModel}


def settings_of_the_library():
    """The frozen dataclasses that validate themselves and can be built with what stands in `NEEDED`."""
    for module in pkgutil.walk_packages(torchfovea.__path__, "torchfovea."):
        if not module.name.startswith(("torchfovea.commands", "torchfovea.__main__")):
            for kind in vars(importlib.import_module(module.name)).values():
                if not (isinstance(kind, type) and dataclasses.is_dataclass(kind) and kind.__module__ == module.name):
                    continue
                bare = (dataclasses.MISSING, dataclasses.MISSING)
                asked = {f.name for f in dataclasses.fields(kind) if (f.default, f.default_factory) == bare}
                if hasattr(kind, "__post_init__") and asked <= NEEDED.get(kind, {}).keys() and kind not in ELSEWHERE:
                    yield kind


SETTINGS = list(settings_of_the_library())


def test_most_settings_are_looked_at():
    assert len(SETTINGS) > 25


@pytest.mark.parametrize("kind", SETTINGS, ids=lambda kind: kind.__name__)
def test_what_is_of_another_type_is_one_line_that_names_it(kind):
    for field in dataclasses.fields(kind):
        refused = 0
        for value in VALUES:
            try:
                kind(**{**NEEDED.get(kind, {}), field.name: value})
            except SettingError as error:
                refused += 1
                assert "\n" not in str(error) and "expected" in str(error)
                if isinstance(value, list | tuple | dict) or value is None:
                    assert field.name in str(error) or field.name == "tuned"  # tune_weights, to the user
                continue
            plain = PLAIN.get(str(field.type))
            assert plain is None or (isinstance(value, plain) and (plain is bool or value is not True)), field.name
        assert refused > 0, field.name


def test_whole_numbers_become_int_and_lists_tuples():
    assert repr(torchfovea.LogPolar(grid=[3.0, 8])) == repr(torchfovea.LogPolar(grid=(3, 8)))
    assert typed([1, 2.5], "Range", "x") == (1.0, 2.5) and typed(None, "int | None", "x") is None
    assert typed(((1, 2), [3, 4]), "tuple[tuple[float, float], ...]", "x") == ((1.0, 2.0), (3.0, 4.0))
    for value, kind, expected in (
        ([1], "Grid", "a list of 2"), ("ab", "Range", "a list of 2"), (3, "tuple[float, ...]", "a list"),
        (1.5, "int", "a whole number"), (math.inf, "int", "a whole number"), (0, "bool", "true or false"),
    ):  # fmt: skip
        with pytest.raises(SettingError, match=f"^x = .*: expected {expected}$"):
            typed(value, kind, "x")
    with pytest.raises(SettingError, match=r"y.alpha = \[\]: expected a number"):
        check_types(dataclasses.replace(Shown(), alpha=[]), "y.")
    with pytest.raises(SettingError, match=r"acquisition.alpha = 1000+: expected a number"):
        Weighting(alpha=10**400)


@dataclasses.dataclass(frozen=True)
class Shown:
    alpha: "float" = 1.0


# ----------------------------------------------------------------------------------------------- what the loop is given

OBSERVER = torchfovea.Observer(camera=Pinhole.from_fov(90.0, 20.0), retina=torchfovea.LogPolar(100, 20.0))
CELLS = torchfovea.sample(torchfovea.direction_mixture([1.0], [[0.0, 0.0, 0.0]], [[1.0, 1.0, 1.0]]), 30, 0)


class Robot:
    """Sees a wall; `changes` are made to its moves and looks."""

    def __init__(self, **changes):
        self.changes = changes

    def saccade(self, gaze):
        return Move(self.changes.get("gaze", gaze), 0.1, 1.0, self.changes.get("base"))

    def look(self, gaze, generator):
        left = OBSERVER.retina.centers_px()
        sigma = torch.full((len(left),), 0.5)
        matches = torchfovea.Correspondences(left, left - torch.tensor([3.0, 0.0]), sigma, sigma, sigma > 0)
        return Look(self.changes.get("matches", matches._replace(valid=self.changes.get("valid", matches.valid))))


ANGLE = torch.tensor(0.1)


@pytest.mark.parametrize(
    ("changes", "given", "line"),
    [
        ({"gaze": torchfovea.Gaze(ANGLE * math.nan, ANGLE, ANGLE)}, {}, "robot.saccade's gaze = [nan, "),
        ({"base": torch.eye(4)}, {}, "step = Tensor: expected a torchfovea.Motion"),
        ({"valid": torch.ones(100)}, {}, "matches.valid.dtype = torch.float32: expected torch.bool"),
        ({"matches": 3}, {}, "matches = int: expected torchfovea.Correspondences"),
        ({}, {"robot": None}, "robot = NoneType: expected something with saccade(gaze) and look(gaze, generator)"),
        ({}, {"observer": None}, "observer = NoneType: expected a torchfovea.Observer"),
        ({}, {"memory": CELLS}, "memory = Tensor: expected a torchfovea.Memory"),
        ({}, {"saccades": 1.5}, "saccades = 1.5: expected a whole number"),
        ({}, {"strategy": "ei"}, "strategy = ei: expected a function of"),
        ({}, {"strategy": lambda view: torch.zeros(3)}, "strategy's scores = (3,): expected (30,), one for each cell"),
        ({}, {"strategy": lambda view: 1.0}, "strategy's scores = float: expected"),
        ({}, {"generator": 3}, "generator = 3: expected a torch.Generator, or one for each row"),
        ({}, {"stop": "x"}, "stop = x: expected (tolerance, probability), or None"),
    ],
    # a lambda's text holds an address, which no other process has
    ids=lambda value: value if isinstance(value, str) else "+".join(value),
)  # fmt: skip
def test_what_the_loop_is_given_is_named(changes, given, line):
    usual = {
        "robot": Robot(**changes), "observer": OBSERVER, "saccades": 2,
        "memory": torchfovea.new_memory(OBSERVER, CELLS),
    }  # fmt: skip
    assert len(list(search(**{**usual, "robot": Robot()}))) == 2
    with pytest.raises(SettingError, match=f"^{re.escape(line)}"):
        list(search(**{**usual, **given}))
