"""What `torchfovea reproduce` refuses before it begins: its own settings, its claims, and those of its cells."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf

from torchfovea.commands.reproduce.cells import METRICS, CellTask, cells_of, in_family
from torchfovea.commands.reproduce.claims import Claim, read_claims
from torchfovea.commands.shared.build import build_observer
from torchfovea.commands.shared.composed import compose_search, options
from torchfovea.commands.shared.parallel import workers_of
from torchfovea.commands.shared.rehearsal import rehearse
from torchfovea.commands.shared.settings import device_of, number, numbers, plain, whole
from torchfovea.setting import require

__all__ = ["Plan", "checked"]


class Plan(NamedTuple):
    """A reproduction that can begin.

    Attributes:
        plain: all settings.
        claims: to judge.
        tasks: to run.
        workers: how many processes, and whose.
    """

    plain: dict[str, Any]
    claims: list[Claim]
    tasks: list[CellTask]
    workers: tuple[int, str]


def checked(cfg: DictConfig) -> Plan:
    """Read every setting, and compose and rehearse a search of every condition.

    Raises:
        SettingError: for whatever cannot be run or judged.
    """
    for name, least in (("episodes", 2), ("saccades", 1), ("seed", 0), ("batch", 1), ("memory.cells", 1)):
        whole(cfg, name, least)
    fields = whole(cfg, "sensor.receptive_fields", 16)
    sample = cfg.sensor.sample
    if sample is not None:
        sample = whole(cfg, "sensor.sample", 16)
        require(sample <= fields, "sensor.sample", sample, f"at most sensor.receptive_fields = {fields}")
    device_of(cfg)
    require(0 < cfg.level < 1, "level", cfg.level, "a probability between 0 and 1")
    whole(cfg, "fig5.vergences", 2), number(cfg, "fig5.peak_tolerance_rad"), number(cfg, "fig5.uniform_share")
    numbers(cfg, "fig5.distances_m", 1e-3)
    for setting in ("fig8.alphas.few", "fig8.alphas.paper", "fig8.alphas.all", "fig9.alphas"):
        numbers(cfg, setting, 0.0, math.inf)
    numbers(cfg, "fig8.fov_deg", 1e-3)
    for setting, group in (
        ("fig8.sensors", "sensor"), ("fig8.others", "acquisition"), ("fig8.extra", "acquisition"),
        ("fig9.biases", "memory"),
    ):  # fmt: skip
        known = options(group)
        for name in OmegaConf.select(cfg, setting):
            require(name in known, setting, name, "some of " + ", ".join(known))
    for setting in ("fig8.conditions", "fig9.conditions"):
        for condition in OmegaConf.select(cfg, setting):
            _condition(condition, setting)
    _condition(cfg.counts, "counts")
    require(cfg.counts in cfg.fig8.conditions, "counts", cfg.counts, "one of fig8.conditions")
    told = in_family(plain(cfg))
    claims, tasks = read_claims(told["claims"]), cells_of(told)
    for claim in claims:
        require(claim.metric in METRICS, f"claims.{claim.id}.metric", claim.metric, "one of " + ", ".join(METRICS))
    seen = set()
    for task in tasks:
        of = task.labels
        what = of["scene"], of["reading"], of["variant"], of["fig"] == "photometric"
        if what not in seen:
            seen.add(what)
            search = compose_search((*task.overrides, *task.arm))
            observer = build_observer(search)
            rehearse(search, observer.head, observer)
    return Plan(told, claims, tasks, workers_of(cfg))


def _condition(node: Any, setting: str) -> None:
    good = OmegaConf.is_dict(node) and set(node) == {"scene", "reading"}
    require(good, setting, node, "{scene: NAME, reading: NAME}")
    for group in ("scene", "reading"):
        known = options(group)
        require(node[group] in known, f"{setting}: {group}", node[group], "one of " + ", ".join(known))
