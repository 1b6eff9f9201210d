"""`torchfovea calibrate`: fit the error budget on some observations with truth, judge it on others."""

from __future__ import annotations

import math
from dataclasses import asdict, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from torchfovea.commands.calibrate.report import bins, print_judgements, regions_of, table
from torchfovea.commands.calibrate.simulated import SceneTask, looks_at_scenes, viewed
from torchfovea.commands.calibrate.truths import Truths, look_at_pair
from torchfovea.commands.shared.budgets import build_budget, made_for, write_budget
from torchfovea.commands.shared.build import build_head, build_matcher, build_sensor
from torchfovea.commands.shared.config import run_folder, sized
from torchfovea.commands.shared.pairs import OWN, Pair, check_named, gaze_of, load_pair, named_pair
from torchfovea.commands.shared.parallel import workers_of
from torchfovea.commands.shared.rehearsal import rehearse
from torchfovea.commands.shared.screen import say
from torchfovea.commands.shared.settings import construct, whole
from torchfovea.commands.shared.unread import refuse_unread
from torchfovea.files import write_csv, write_result
from torchfovea.sensing.correspondence import Budget
from torchfovea.setting import require
from torchfovea.stereo.external import External
from torchfovea.stereo.health import heed
from torchfovea.stereo.matchers import Matcher
from torchfovea.studies.calibration import Judged, concatenate, inlier_of, judge, select, sigma_of
from torchfovea.studies.fitting import BudgetFit, Likelihood, claim_rank, fit_budget, least_match_px
from torchfovea.studies.shared_errors import KnownLook, lasting_share_of, shared_share

__all__ = ["run"]

QUICK = {"scenes": 2, "judged_scenes": 2, "looks": 2}
FULL = {"scenes": 16, "judged_scenes": 16, "looks": 2}
JUDGED_SEEDS = 1000  # scenes to judge on have seeds from here, so that none is fitted on
CHANCE = 1e-3  # a rank correlation that chance makes less often is one
TURNED = {"confidence": "doubt", "doubt": "confidence"}
SHARPEST_PX = 0.01  # a fit whose median σ of a disparity is below this has collapsed


class Split(NamedTuple):
    """Observations of one kind.

    Attributes:
        fitted: to fit on.
        judged: to judge on; the same where every other scene judges it (`Split.left_out`).
        looks: all of them.
        scenes: the looks of each scene that was fitted on.
        left_out: whether a budget fitted without it is judged too.
    """

    fitted: Judged
    judged: Judged
    looks: list[Truths]
    scenes: list[list[Truths]]
    left_out: bool = False


def run(cfg: DictConfig) -> float:
    """Calibrate; the mixture's negative log-likelihood of what was judged on is what a sweeper sees."""
    refuse_unread("sensor.sample")
    if cfg.real is False:
        refuse_unread("pair", *OWN, "gaze_px", only="with real=true")
    cfg = sized(cfg, QUICK, FULL)
    scenes, judged_scenes = whole(cfg, "scenes", 0), whole(cfg, "judged_scenes")
    whole(cfg, "looks"), whole(cfg, "seed", 0), workers_of(cfg)
    require(scenes > 0 or cfg.real or len(cfg.pairs) > 0, "scenes", scenes, "at least 1, real=true or pairs")
    build_sensor(cfg)
    budget = build_budget(cfg)
    start = replace(budget, source_px=whole(cfg, "sensor.source_px", 16))
    matcher = build_matcher(cfg)
    likelihood = construct(Likelihood, cfg.fit, "fit")
    edges = _edges(cfg, "range_edges_m"), _edges(cfg, "eccentricity_edges_deg")
    angles = _edges(cfg, "fovs_deg", least=1) if len(cfg.fovs_deg) else [float(cfg.sensor.fov_deg)]
    for fov_deg in angles:
        build_sensor(viewed(cfg, fov_deg))
    rehearse(cfg, build_head(cfg))
    for k, name in enumerate(cfg.pairs):
        check_named(name, f"pairs[{k}]")
    real = load_pair(cfg) if cfg.real else None
    gaze = None if real is None else gaze_of(cfg, real)
    folder = run_folder()
    # the files first: they can be broken, and are soon looked at
    data = _pairs(cfg, start, matcher, real, gaze)
    if scenes:
        data = {"simulated": _simulate(cfg, start, scenes, judged_scenes, angles), **data}
    rank = _agreement(matcher, data)

    def fit(*without: str) -> BudgetFit:
        chosen = {name: split for name, split in data.items() if name not in without}
        step = max(look.step_px for split in chosen.values() for look in split.looks)
        return fit_budget([split.fitted for split in chosen.values()], start, likelihood, least_match_px(step))

    found = fit()
    models = {name: {"before": budget, "after": found.budget} for name in data}
    if len(data) > 1:
        for name, split in data.items():
            if split.left_out:
                models[name]["left_out"] = fit(name).budget
    after = _sharing(found.budget, data)
    models = {name: laws | {"after": after} for name, laws in models.items()}
    figures: dict[str, Any] = {}
    for kind, split in data.items():
        prefix = "" if kind == next(iter(data)) else f"{kind}."
        area = split.judged.area()
        for model, law in models[kind].items():
            claims = sigma_of(split.judged, law), inlier_of(split.judged, law)
            for suffix, weight in (("", None), ("_by_area", area)):
                for name, value in judge(split.judged, *claims, weight).items():
                    figures[f"{prefix}{model}.{name}{suffix}"] = value
            figures |= {f"{prefix}{model}.{k}": v for k, v in regions_of(split.judged, *claims).items()}
        figures[f"{prefix}observations"] = split.judged.error.numel()
        for k, suffix in enumerate(("", "_by_area")):
            figures[f"{prefix}valid_fraction{suffix}"] = _mean([look.valid_share[k] for look in split.looks])
            figures[f"{prefix}hidden_valid{suffix}"] = _mean([look.hidden_valid_share[k] for look in split.looks])
    numbers = {name: value for name, value in asdict(after).items() if name != "source_px"}
    figures |= {f"fit.{name}": value for name, value in numbers.items()}
    figures |= {"fit.loss": found.loss, "fit.first_loss": found.first_loss, "claim_rank_correlation": rank}
    write_csv(folder / "bins.csv", *bins({k: s.judged for k, s in data.items()}, models, *edges))
    write_csv(folder / "reliability.csv", *table({k: s.judged for k, s in data.items()}, models))
    from torchfovea.commands.calibrate.pictures import draw_calibration

    draw_calibration(
        folder / "calibration.png",
        {kind: (s.judged, {m: sigma_of(s.judged, law) for m, law in models[kind].items()}) for kind, s in data.items()},
    )
    write_result(folder, figures)
    print_judgements(figures, {kind: list(laws) for kind, laws in models.items()})
    _refuse(figures, data, models, after)
    _write(folder / "budget" / "fitted.yaml", after, cfg, data, angles)
    return float(figures["after.mixture_nll"])


def _simulate(cfg: DictConfig, budget: Budget, scenes: int, judged_scenes: int, angles: list[float]) -> Split:
    """Random looks at simulated scenes, in turn at each field of view; those to judge on have seeds of their own."""
    seed, looks = whole(cfg, "seed", 0), whole(cfg, "looks")
    seeds = [seed + k for k in range(scenes)], [seed + JUDGED_SEEDS + k for k in range(judged_scenes)]
    plain = OmegaConf.masked_copy(cfg, [str(key) for key in cfg if key != "hydra"])
    tasks = [SceneTask(plain, budget, k, angles[i % len(angles)], looks) for part in seeds for i, k in enumerate(part)]
    found = looks_at_scenes(tasks)
    parts = found[:scenes], found[scenes:]
    fitted, judged = (_known(concatenate([look.data for looks in part for look in looks])) for part in parts)
    return Split(fitted, judged, [look for part in parts for looks in part for look in looks], parts[0])


def _pairs(
    cfg: DictConfig, budget: Budget, matcher: Matcher, real: Pair | None, gaze: tuple[float, float] | None
) -> dict[str, Split]:
    """Pairs with truth: a whole one is a scene; of the real one either half is."""
    retina = build_sensor(cfg)[1]
    found: dict[str, Split] = {}
    for k, name in enumerate(cfg.pairs):
        look = look_at_pair(named_pair(name, f"pairs[{k}]"), retina, None, budget, matcher)
        data, title = _known(look.data), Path(str(name)).name
        require(title not in (*found, "simulated", "real", "real_left"), f"pairs[{k}]", name, "a name of its own")
        found[title] = Split(data, data, [look], [], left_out=True)
    if real is not None:
        heed(real.faults, True)
        look = look_at_pair(real, retina, gaze, budget, matcher)
        column = look.data.place_px[:, 0]
        # the retina looks at the picture's middle, or at the gaze
        left, right = (_known(select(look.data, half)) for half in (column < 0, column >= 0))
        found["real"] = Split(left, right, [look], [])
        if cfg.pairs:
            found["real"] = Split(right, right, [look], [], left_out=True)
            found["real_left"] = Split(left, left, [look], [], left_out=True)
    return found


def _agreement(matcher: Matcher, data: dict[str, Split]) -> float:
    """The rank correlation of what the matcher claims with its errors; one line on stderr where it is turned round."""
    rank, chance = claim_rank([split.fitted for split in data.values()])
    if isinstance(matcher.params, External) and rank < 0 and chance < CHANCE:
        tells, other = matcher.params.tells, TURNED.get(matcher.params.tells)
        turned = "" if other is None else f"; matcher.tells={other} turns it round"
        line = f"matcher.tells = {tells}: errors shrink where it claims that they grow (rank correlation {rank:.2f})"
        say(f"{line}: expected the opposite{turned}")
    return rank


def _sharing(budget: Budget, data: dict[str, Split]) -> Budget:
    """The budget with what errors have in common, where the looks tell."""
    shared = shared_share([look.data for split in data.values() for look in split.looks], budget)
    sights = [
        [KnownLook(t.data, t.point_m, t.axis) for t in looks] for split in data.values() for looks in split.scenes
    ]
    lasting = lasting_share_of(sights, budget)
    if shared is not None:
        share, factor = shared
        px, widths = (factor * length for length in (budget.shared_px, budget.shared_widths))
        budget = replace(budget, shared=share, shared_px=px, shared_widths=widths, lasting=min(budget.lasting, share))
    return budget if lasting is None else replace(budget, lasting=min(lasting, budget.shared))


def _refuse(figures: dict[str, Any], data: dict[str, Split], models: dict[str, dict[str, Budget]], law: Budget) -> None:
    """Refuse a fit that is worse than before on what it did not see, or whose σ collapses."""
    for kind in data:
        prefix = "" if kind == next(iter(data)) else f"{kind}."
        model = "left_out" if "left_out" in models[kind] else "after"
        then, now = (figures[f"{prefix}{m}.mixture_nll_by_area"] for m in ("before", model))
        good = now <= then
        require(good, f"fit: {kind}, {model}, mixture_nll_by_area", f"{now:.3f}", f"at most {then:.3f}, as before")
    for split in data.values():
        sharp = sigma_of(split.fitted, law) / (split.fitted.right_gain * split.fitted.pixel_px)
        median = float(sharp.median())
        require(median > SHARPEST_PX, "fit: median σ", f"{median:.2g} px", f"more than {SHARPEST_PX} source pixels")


def _write(path: Path, law: Budget, cfg: DictConfig, data: dict[str, Split], angles: list[float]) -> None:
    """The fitted budget as a file of the group `budget`."""
    simulated = [f"{cfg.scenes} scenes {cfg.scene.name}, {cfg.looks} looks each"] if cfg.scenes else []
    pairs = [name.replace("real_left", "its other half").replace("real", "half a pair") for name in data]
    command = " ".join(HydraConfig.get().overrides.task)
    comments = [
        "Fitted by torchfovea calibrate; torchfovea.sensing.correspondence.Budget says what the numbers are.",
        f"Command: torchfovea calibrate {command}",
        f"Fitted on: {', '.join(simulated + [name for name in pairs if name != 'simulated'])}",
    ]
    sizes = [cfg.sensor.source_px] if cfg.scenes else []
    sizes += [
        round(2 * cfg.sensor.radius_px / float(s.judged.pixel_px[0])) for k, s in data.items() if k != "simulated"
    ]
    write_budget(path, law, comments, cfg.budget.sigma_points, made_for(cfg, angles if cfg.scenes else [], sizes))


def _known(data: Judged) -> Judged:
    count = data.error.numel()
    require(count >= 100, "observations with truth", count, "at least 100 valid receptive fields whose truth is known")
    return data


def _mean(values: list[float]) -> float:
    known = [v for v in values if math.isfinite(v)]
    return sum(known) / len(known) if known else math.nan


def _edges(cfg: DictConfig, setting: str, least: int = 2) -> list[float]:
    values = OmegaConf.select(cfg, setting)
    count = {1: "ascending numbers", 2: "two or more ascending numbers"}[least]
    require(len(values) >= least and all(a < b for a, b in pairwise(values)), setting, values, count)
    return [float(v) for v in values]
