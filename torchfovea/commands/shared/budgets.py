"""Error budgets as files: what they must hold, what they are for, which one comes along, and writing a fitted one."""

from __future__ import annotations

from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from torchfovea.commands.shared.config import conf_dir
from torchfovea.commands.shared.screen import say
from torchfovea.commands.shared.settings import choice, construct, plain, whole
from torchfovea.files import replacing
from torchfovea.sensing.correspondence import Budget
from torchfovea.setting import SettingError, require

__all__ = ["build_budget", "load_budget", "made_for", "shipped", "write_budget"]

NUMBERS = tuple(field.name for field in fields(Budget) if field.name != "source_px")
KEYS = (*NUMBERS, "source", "sigma_points", "made_for")
PURPOSE = ("matcher", "layout", "receptive_fields", "fov_deg", "source_px")
SIZE = 2.0  # a source this many times larger or smaller is another one


def build_budget(cfg: DictConfig, pair: bool = False) -> Budget:
    """The error budget of a configuration; one line on stderr says where it was made for something else.

    ``budget=auto`` leaves its numbers empty: they are those that come along for the configuration's layout and matcher
    (`shipped`), or the uncalibrated ones where none do, which is said too. A number that is set wins.

    Args:
        cfg: with the groups budget, sensor and matcher.
        pair: whether the images bring their own field of view and size.

    Raises:
        SettingError: for a budget that lacks a number or has one that no budget knows, and for impossible numbers.
    """
    node = _checked(cfg.budget, "budget")
    choice(cfg, "budget.sigma_points", ("ours", "paper"))
    source_px = whole(cfg, "sensor.source_px", 16)
    if any(node[name] is None for name in NUMBERS):
        node = _filled(cfg, node)
    require(isinstance(node["source"], bool), "budget.source", node["source"], "true or false")
    if node["made_for"] is not None:
        _compare(cfg, node["made_for"], pair)
    source = source_px if node["source"] else None
    return construct(Budget, {**{name: node[name] for name in NUMBERS}, "source_px": source}, "budget")


def load_budget(name: str, source_px: int = 400) -> Budget:
    """A budget that comes along, by its name in ``conf/budget``: LAYOUT_MATCHER, for rendered pictures ``_rendered``.

    Args:
        name: such as ``log_polar_sgbm``.
        source_px: side of the pictures [px].

    Raises:
        SettingError: for a name that none has.
    """
    path = Path(conf_dir()) / "budget" / f"{name}.yaml"
    known = sorted(p.stem for p in path.parent.glob("*.yaml") if p.stem != "auto")
    require(name in known, "budget", name, "one of " + ", ".join(known))
    node = _checked(OmegaConf.load(path), str(path))
    return Budget(**{number: node[number] for number in NUMBERS}, source_px=source_px if node["source"] else None)


def shipped(cfg: DictConfig) -> Path | None:
    """The budget that comes along for a configuration's layout and matcher; None where there is none.

    Rendered pictures have one of their own, ``LAYOUT_MATCHER_rendered.yaml``: they are free of noise, and their eyes
    are alike.
    """
    rendered = "_rendered" if OmegaConf.select(cfg, "fidelity") is not None else ""
    path = Path(conf_dir()) / "budget" / f"{cfg.sensor.layout}_{cfg.matcher.name}{rendered}.yaml"
    return path if path.is_file() else None


def made_for(cfg: DictConfig, fov_deg: list[float], source_px: list[int]) -> dict[str, Any]:
    """What a budget names as its purpose: the matcher with its settings, the sensor, fields of view and image sizes."""
    return {
        "matcher": plain(cfg.matcher), "layout": cfg.sensor.layout, "receptive_fields": cfg.sensor.receptive_fields,
        "fov_deg": sorted(set(fov_deg)), "source_px": sorted(set(source_px)),
    }  # fmt: skip


def write_budget(path: Path, budget: Budget, comments: list[str], sigma_points: str, purpose: dict[str, Any]) -> None:
    """A budget as a file of the group `budget`, numbers to five digits."""
    numbers = {name: float(f"{value:.5g}") for name, value in asdict(budget).items() if name in NUMBERS}
    node = {**numbers, "source": budget.source_px is not None, "sigma_points": sigma_points, "made_for": purpose}
    text = "".join(f"# {line}\n" for line in comments) + OmegaConf.to_yaml(OmegaConf.create(node))
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _checked(node: Any, where: str) -> dict[str, Any]:
    """A budget's settings, all of them and no others."""
    require(OmegaConf.is_dict(node), where, node, "a budget: a mapping of its numbers")
    values = plain(node)
    missing = [name for name in KEYS if name not in values]
    unknown = [name for name in values if name not in KEYS]
    if missing:
        raise SettingError(f"{where}.{missing[0]} = missing: expected all of {', '.join(KEYS)}")
    if unknown:
        raise SettingError(f"{where}.{unknown[0]} = {values[unknown[0]]}: expected one of {', '.join(KEYS)}")
    purpose = values["made_for"]
    told = purpose is None or (isinstance(purpose, dict) and set(PURPOSE) <= set(purpose))
    expected = f"null, or what `torchfovea calibrate` writes: {', '.join(PURPOSE)}"
    require(told, f"{where}.made_for", purpose, expected)
    return values


def _filled(cfg: DictConfig, node: dict[str, Any]) -> dict[str, Any]:
    # where nothing is matched, the noise is what the budget says, and independent
    geometric = OmegaConf.select(cfg, "fidelity") == "geometric" or "matcher" not in cfg
    path = Path(conf_dir()) / "budget" / "ours.yaml" if geometric else shipped(cfg)
    if path is None:
        say(
            f"budget = auto: none comes along for {cfg.sensor.layout} and {cfg.matcher.name}, the uncalibrated one is "
            "used (torchfovea calibrate fits one)"
        )
        path = Path(conf_dir()) / "budget" / "ours.yaml"
    found = _checked(OmegaConf.load(path), str(path))
    given = {name: value for name, value in node.items() if name in NUMBERS and value is not None}
    return {**found, **given, "source": node["source"], "sigma_points": node["sigma_points"]}


def _compare(cfg: DictConfig, purpose: Any, pair: bool) -> None:
    """Say in one line where a budget was made for something else."""
    other = [] if cfg.sensor.layout == purpose["layout"] else [f"sensor.layout = {purpose['layout']}"]
    matcher = plain(cfg.matcher)
    other += [f"matcher.{k} = {v}" for k, v in purpose["matcher"].items() if k in matcher and matcher[k] != v]
    if not pair:
        sizes, angles = purpose["source_px"], purpose["fov_deg"]
        if not min(sizes) / SIZE <= cfg.sensor.source_px <= SIZE * max(sizes):
            other.append(f"sensor.source_px = {sizes}")
        if angles and not min(angles) - 5 <= cfg.sensor.fov_deg <= max(angles) + 5:
            other.append(f"sensor.fov_deg = {angles}")
    if other:
        say(f"the budget was fitted with {'; '.join(other)}")
