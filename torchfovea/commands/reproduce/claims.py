"""Claims about episodes: paired contrasts over scenes, with intervals and verdicts that no one wrote beforehand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from torchfovea.setting import require
from torchfovea.studies.significance import bootstrap_interval, holm, sign_flip_p_value

__all__ = ["Claim", "Verdict", "judge_claims", "read_claims", "rows_where"]

Row = Mapping[str, Any]


@dataclass(frozen=True)
class Claim:
    """A claim and its operational definition.

    Attributes:
        id: a short name.
        section: of the paper.
        text: in the paper's words, or nearly.
        metric: a column of the episodes.
        plus: which episodes: a column's name to a value or a list of values.
        minus: to compare with, scene by scene; None: with the threshold.
        threshold: a number to compare with.
        sign: `greater` or `less` than 0, or `equal`, which is within ±margin.
        margin: of `equal`.
        plus_pick: instead of averaging all arms, take the one of the `highest` or `lowest` mean.
        minus_pick: likewise.
    """

    id: str
    section: str
    text: str
    metric: str
    plus: Row
    minus: Row | None = None
    threshold: float = 0.0
    sign: str = "greater"
    margin: float = 0.0
    plus_pick: str | None = None
    minus_pick: str | None = None

    def __post_init__(self) -> None:
        """Raise SettingError for words that are not known."""
        where = f"claims.{self.id}"
        require(self.sign in ("greater", "less", "equal"), f"{where}.sign", self.sign, "greater, less or equal")
        for name in ("plus_pick", "minus_pick"):
            value = getattr(self, name)
            require(value in (None, "highest", "lowest"), f"{where}.{name}", value, "highest or lowest")
        require(self.sign != "equal" or self.margin > 0, f"{where}.margin", self.margin, "a positive number")

    @property
    def definition(self) -> str:
        """What is computed, in words."""
        right = f"{self.threshold:g}" if self.minus is None else _named(self.minus, self.minus_pick)
        ends = {"greater": "is greater than 0", "less": "is less than 0", "equal": f"lies within ±{self.margin:g}"}
        left = _named(self.plus, self.plus_pick)
        return f"{self.metric}: {left} minus {right}, mean over scenes, {ends[self.sign]}"


@dataclass(frozen=True)
class Verdict:
    """What became of a claim; numbers are None where no scene has the metric.

    Attributes:
        verdict: `holds`, `fails` (the opposite holds) or `undecided`.
        estimate: mean difference over scenes.
        ci_low: of its bootstrap interval.
        ci_high: of its bootstrap interval.
        effect_size: the mean over the standard deviation of the scenes' differences.
        p_value: two-sided, of the sign-flip test, before the correction.
        p_holm: after it.
        n: scenes.
    """

    verdict: str
    estimate: float | None
    ci_low: float | None
    ci_high: float | None
    effect_size: float | None
    p_value: float | None
    p_holm: float | None
    n: int


def _named(chosen: Row, pick: str | None) -> str:
    parts = []
    for key, value in chosen.items():
        if key != "fig":
            parts.append(", ".join(map(str, value)) if isinstance(value, list | tuple) else f"{key} {value}")
    return f"[{'; '.join(parts) or 'all'}{f'; the {pick} of them' if pick else ''}]"


def read_claims(settings: Sequence[Mapping[str, Any]]) -> list[Claim]:
    """Claims from their settings.

    Raises:
        SettingError: for a claim without a name, a name that comes twice, or settings that a claim does not have.
    """
    claims: list[Claim] = []
    for entry in settings:
        name = entry.get("id")
        known = Claim.__dataclass_fields__
        for key in entry:
            require(key in known, f"claims.{name}.{key}", entry[key], "one of " + ", ".join(known))
        missing = [key for key in ("id", "section", "text", "metric", "plus") if entry.get(key) is None]
        require(not missing, f"claims.{name}", f"no {', '.join(missing)}", "id, section, text, metric and plus")
        require(name not in [c.id for c in claims], "claims", name, "a name that comes once")
        claims.append(Claim(**{**entry, "section": str(entry["section"])}))
    return claims


def rows_where(rows: Sequence[Row], chosen: Row) -> list[Row]:
    """The episodes of a selection."""

    def fits(row: Row) -> bool:
        return all(
            row.get(key) in value if isinstance(value, list | tuple) else row.get(key) == value
            for key, value in chosen.items()
        )

    return [row for row in rows if fits(row)]


def _by_scene(rows: Sequence[Row], metric: str, chosen: Row, pick: str | None) -> dict[int, float]:
    """Mean of a metric for each scene; only cells that every scene has, so that scenes stay comparable."""
    found = [row for row in rows_where(rows, chosen) if row.get(metric) is not None]
    arms: dict[Any, list[Row]] = {}
    for row in found:
        arms.setdefault((row.get("arm"), row.get("bias")), []).append(row)
    if pick is not None and arms:
        mean = {arm: sum(r[metric] for r in part) / len(part) for arm, part in arms.items()}
        best = (max if pick == "highest" else min)(mean, key=lambda arm: mean[arm])
        found = arms[best]
    scenes: dict[int, list[float]] = {}
    for row in found:
        scenes.setdefault(row["seed"], []).append(float(row[metric]))
    most = max((len(values) for values in scenes.values()), default=0)
    return {seed: sum(values) / len(values) for seed, values in scenes.items() if len(values) == most}


def _differences(claim: Claim, rows: Sequence[Row]) -> torch.Tensor:
    left = _by_scene(rows, claim.metric, claim.plus, claim.plus_pick)
    if claim.minus is None:
        return torch.tensor([left[s] - claim.threshold for s in sorted(left)], dtype=torch.float64)
    right = _by_scene(rows, claim.metric, claim.minus, claim.minus_pick)
    both = sorted(left.keys() & right.keys())
    return torch.tensor([left[s] - right[s] for s in both], dtype=torch.float64)


def judge_claims(claims: Sequence[Claim], rows: Sequence[Row], level: float = 0.95, seed: int = 0) -> list[Verdict]:
    """Judge a family of claims on the same episodes.

    The scene is the unit: differences are taken within a scene, their mean is bootstrapped over scenes, and tested by
    flipping signs, two-sided, with Holm's correction over the claims of the family. `greater` and `less` hold where the
    corrected test rejects with that sign, and fail where it rejects with the other. `equal` holds where the interval
    lies within the margin, and fails where it lies outside.

    Args:
        claims: the family.
        rows: one for each episode, with `seed` (the scene), `arm`, `bias` and the metrics.
        level: of confidence.
        seed: of the resampling.
    """
    found = [_differences(claim, rows) for claim in claims]
    tested = [k for k, d in enumerate(found) if len(d) >= 2]
    p_values = torch.tensor(
        [float(sign_flip_p_value(found[k], torch.Generator().manual_seed(seed))) for k in tested], dtype=torch.float64
    )
    corrected = dict(zip(tested, zip(p_values.tolist(), holm(p_values).tolist(), strict=True), strict=True))
    verdicts = []
    for k, (claim, d) in enumerate(zip(claims, found, strict=True)):
        if k not in corrected:
            verdicts.append(Verdict("undecided", None, None, None, None, None, None, len(d)))
            continue
        interval = bootstrap_interval(d, torch.Generator().manual_seed(seed), level)
        estimate, low, high = (float(x) for x in interval)
        spread = float(d.std())
        p, p_holm = corrected[k]
        if claim.sign == "equal":
            inside = -claim.margin <= low and high <= claim.margin
            outside = low > claim.margin or high < -claim.margin
            verdict = "holds" if inside else "fails" if outside else "undecided"
        elif p_holm > 1 - level:
            verdict = "undecided"
        else:
            verdict = "holds" if (estimate > 0) == (claim.sign == "greater") else "fails"
        size = estimate / spread if spread > 0 else None
        verdicts.append(Verdict(verdict, estimate, low, high, size, p, p_holm, len(d)))
    return verdicts
