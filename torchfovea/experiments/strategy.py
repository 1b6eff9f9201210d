"""The strategy of looking that a configuration describes."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from torchfovea.deciding import strategies
from torchfovea.deciding.strategies import Strategy
from torchfovea.perception import Observer
from torchfovea.setting import require

__all__ = ["STRATEGIES", "StopRule", "build_stop", "build_strategy", "read_number"]

STRATEGIES = (
    "ucb", "pi", "ei", "log_ei", "thompson", "infomax", "infomax_cost", "ucb_cost", "ei_cost", "hedge", "random",
    "raster", "first_glance", "oracle",
)  # fmt: skip

StopRule = tuple[float, float]


def read_number(cfg: DictConfig, setting: str, expected: str, least: float = -math.inf) -> float:
    """A number read at a dotted name, not below `least`."""
    value = OmegaConf.select(cfg, setting)
    good = isinstance(value, int | float) and not isinstance(value, bool) and value >= least
    require(good, setting, value, expected)
    assert value is not None
    return float(value)


def build_strategy(cfg: DictConfig, observer: Observer, best: Tensor | None = None) -> Strategy:
    """The strategy by its name.

    Args:
        cfg: with the group `acquisition`.
        observer: whose sensor the strategies with foresight know.
        best: true direction of the best point (..., 3), for the oracle alone.

    Raises:
        SettingError: for an unknown name or a setting out of range.
    """
    name = OmegaConf.select(cfg, "acquisition.name")
    require(name in STRATEGIES, "acquisition", name, "one of " + ", ".join(STRATEGIES))
    known: dict[str, Any] = {
        "pi": strategies.probability_of_improvement,
        "ei": strategies.expected_improvement,
        "log_ei": strategies.log_expected_improvement,
        "thompson": strategies.thompson,
        "random": strategies.random,
        "first_glance": strategies.first_glance,
    }
    if name in known:
        return known[name]
    if name in ("ucb", "ucb_cost", "hedge"):
        alpha = read_number(cfg, "acquisition.alpha", "a number of at least 0, or inf", 0.0)
    if name == "ucb":
        return partial(strategies.upper_confidence_bound, alpha=alpha)
    if name == "oracle":
        ahead = torch.tensor([1.0, 0.0, 0.0])
        return partial(strategies.oracle, best=ahead if best is None else best)
    if name == "raster":
        spacing = read_number(cfg, "acquisition.spacing_deg", "an angle between 0 and 180 degrees", 0.0)
        return partial(strategies.raster, spacing_deg=spacing)
    if name == "hedge":
        eta = read_number(cfg, "acquisition.eta", "a number of at least 0", 0.0)
        members = (
            partial(strategies.upper_confidence_bound, alpha=alpha),
            strategies.probability_of_improvement,
            strategies.expected_improvement,
        )
        return partial(strategies.hedge, members=members, eta=eta)
    if name == "infomax":
        return _infomax(cfg, observer, None, "degrees")
    unit = OmegaConf.select(cfg, "acquisition.unit")
    require(unit in ("degrees", "seconds"), "acquisition.unit", unit, "degrees or seconds")
    if name == "ucb_cost":
        weight = read_number(cfg, "acquisition.weight", "reward per degree or second, at least 0", 0.0)
        return partial(strategies.upper_confidence_bound_less_cost, alpha=alpha, weight=weight, unit=unit)
    overhead = read_number(cfg, "acquisition.overhead", "a positive number of degrees or seconds", 1e-9)
    if name == "ei_cost":
        return partial(strategies.expected_improvement_per_cost, overhead=overhead, unit=unit)
    return _infomax(cfg, observer, overhead, unit)


def _infomax(cfg: DictConfig, observer: Observer, overhead: float | None, unit: str) -> Strategy:
    edge = torch.tensor([observer.retina.radius_px, 0.0], dtype=torch.float64)
    x, _, z = observer.camera.rays(edge).unbind(-1)
    return partial(
        strategies.information_gain,
        law=strategies.inverse_range_acuity(
            observer.camera, observer.retina, observer.budget, observer.head.baseline_m
        ),
        half_view_rad=float(torch.atan2(x, z)),
        in_range=observer.reward == "range",
        overhead=overhead,
        unit=unit,
    )


def build_stop(cfg: DictConfig) -> StopRule | None:
    """When the best is known well enough: (tolerance, probability), or None for never."""
    if OmegaConf.select(cfg, "stop.probability") is None:
        return None
    tolerance = read_number(cfg, "stop.tolerance", "a number of at least 0, in the units of the reward", 0.0)
    probability = read_number(cfg, "stop.probability", "a probability between 0 and 1, or null", 0.0)
    require(0 < probability < 1, "stop.probability", probability, "a probability between 0 and 1, or null")
    return tolerance, probability
