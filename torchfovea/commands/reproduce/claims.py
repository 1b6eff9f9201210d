"""Claims about episodes: paired contrasts over scenes, with intervals and verdicts that no one wrote beforehand."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from torchfovea.setting import require
from torchfovea.studies.significance import bootstrap_interval, holm, sign_flip_p_value, studentized_p_value

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
        margin: of `equal`; with `greater` and `less` the least difference that counts.
        plus_pick: compare the `highest` or the `lowest` of the arms, instead of their average: see `judge_claims`.
        minus_pick: likewise.
        arms: compare each arm with itself: the claim is about every one.
        note: what a reader should know of the claim.
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
    arms: bool = False
    note: str | None = None

    def __post_init__(self) -> None:
        """Raise SettingError for words that are not known."""
        where = f"claims.{self.id}"
        require(self.sign in ("greater", "less", "equal"), f"{where}.sign", self.sign, "greater, less or equal")
        for name in ("plus_pick", "minus_pick"):
            value = getattr(self, name)
            require(value in (None, "highest", "lowest"), f"{where}.{name}", value, "highest or lowest")
        require(self.sign != "equal" or self.margin > 0, f"{where}.margin", self.margin, "a positive number")
        require(self.margin >= 0, f"{where}.margin", self.margin, "at least 0")
        ways = (self.plus_pick is not None) + (self.minus_pick is not None) + self.arms
        require(ways <= 1, f"{where}.arms", self.arms, "one of plus_pick, minus_pick and arms, or none")
        require(ways == 0 or self.sign != "equal", f"{where}.sign", self.sign, "greater or less, for picks and arms")

    @property
    def definition(self) -> str:
        """What is computed, in words."""
        right = f"{self.threshold:g}" if self.minus is None else _named(self.minus, self.minus_pick)
        ends = {
            "greater": f"is greater than {self.margin:g}",
            "less": f"is less than {-self.margin if self.margin else 0:g}",
            "equal": f"lies within ±{self.margin:g}",
        }
        left = _named(self.plus, self.plus_pick)
        every = ", for every arm" if self.arms else ""
        return f"{self.metric}: {left} minus {right}, mean over scenes, {ends[self.sign]}{every}"

    @property
    def every(self) -> bool:
        """Whether the claim is about every one of its contrasts; else about any."""
        ahead = {"greater": "lowest", "less": "highest"}.get(self.sign)
        return self.arms or self.plus_pick == ahead or (self.minus_pick is not None and self.minus_pick != ahead)


@dataclass(frozen=True)
class Verdict:
    """What became of a claim; numbers are None where no scene has the metric.

    Attributes:
        verdict: `holds`, `fails` (the opposite holds) or `undecided`.
        estimate: mean difference over scenes.
        ci_low: of its bootstrap interval.
        ci_high: of its bootstrap interval.
        effect_size: the mean over the standard deviation of the scenes' differences.
        p_value: two-sided, the larger of the sign flip's and the studentized bootstrap's, before the correction.
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


def _by_scene(rows: Sequence[Row], metric: str, chosen: Row) -> dict[int, float]:
    """Mean of a metric for each scene; only cells that every scene has, so that scenes stay comparable."""
    scenes: dict[int, list[float]] = {}
    for row in rows_where(rows, chosen):
        if row.get(metric) is not None:
            scenes.setdefault(row["seed"], []).append(float(row[metric]))
    most = max((len(values) for values in scenes.values()), default=0)
    return {seed: sum(values) / len(values) for seed, values in scenes.items() if len(values) == most}


def _each(rows: Sequence[Row], metric: str, chosen: Row) -> list[Row]:
    """A selection's arms and biases, each a selection of its own."""
    there = rows_where(rows, chosen)
    kinds = dict.fromkeys((row.get("arm"), row.get("bias")) for row in there if row.get(metric) is not None)
    return [{**chosen, "arm": arm, "bias": bias} for arm, bias in kinds]


def _contrasts(claim: Claim, rows: Sequence[Row]) -> list[torch.Tensor]:
    """Differences scene by scene, of every pair of selections that the claim compares and that have scenes."""
    plus: list[Row] = [claim.plus] if claim.plus_pick is None else _each(rows, claim.metric, claim.plus)
    minus: list[Row | None] = [claim.minus]
    if claim.minus is not None and claim.minus_pick is not None:
        minus = list(_each(rows, claim.metric, claim.minus))
    pairs: list[tuple[Row, Row | None]] = [(one, other) for one in plus for other in minus]
    if claim.arms:
        each = _each(rows, claim.metric, claim.plus)
        pairs = [(one, None if claim.minus is None else {**claim.minus, "arm": one["arm"]}) for one in each]
    found = []
    for one, other in pairs:
        left = _by_scene(rows, claim.metric, one)
        right = dict.fromkeys(left, claim.threshold) if other is None else _by_scene(rows, claim.metric, other)
        both = sorted(left.keys() & right.keys())
        found.append(torch.tensor([left[s] - right[s] for s in both], dtype=torch.float64))
    return [d for d in found if len(d) >= 2]


def _p_value(d: torch.Tensor, seed: int) -> float:
    """The more careful of two tests: each is right where the other may not be, and a skew betrays the sign flip."""
    tests = (sign_flip_p_value, studentized_p_value)
    return max(float(test(d, torch.Generator().manual_seed(seed))) for test in tests)


def _tested(claim: Claim, found: Sequence[torch.Tensor], seed: int) -> tuple[torch.Tensor, float, bool]:
    """The contrast that decides a claim, its p-value, and whether it points the claim's way.

    A claim about every contrast is as sure as its least sure one (intersection-union, Berger 1982), and fails where any
    points the other way, corrected for their number; one about any, the other way round.
    """
    sign = -1.0 if claim.sign == "less" else 1.0
    least = 0.0 if claim.sign == "equal" else claim.margin
    shifted = [sign * d - least for d in found]
    p = [_p_value(d, seed) for d in shifted]
    towards = [float(d.mean()) > 0 for d in shifted]
    means = [float(d.mean()) for d in shifted]
    weakest, strongest = means.index(min(means)), means.index(max(means))
    if claim.every:
        if all(towards):
            k = max(range(len(p)), key=lambda k: (p[k], -means[k]))
            return found[k], p[k], True
        against = [k for k, ahead in enumerate(towards) if not ahead]
        return found[weakest], min(1.0, len(found) * min(p[k] for k in against)), False
    if any(towards):
        best = min(p[k] for k, ahead in enumerate(towards) if ahead)
        return found[strongest], min(1.0, len(found) * best), True
    k = p.index(max(p))
    return found[k], p[k], False


def judge_claims(claims: Sequence[Claim], rows: Sequence[Row], level: float = 0.95, seed: int = 0) -> list[Verdict]:
    """Judge a family of claims on the same episodes.

    The scene is the unit: differences are taken within a scene, their mean is bootstrapped over scenes, and tested
    two-sided by flipping signs and by the studentized bootstrap, of which the larger p-value counts, with Holm's
    correction over the claims of the family. `greater` and `less` hold where the corrected test rejects with that sign,
    and fail where it rejects with the other. `equal` holds where the interval lies within the margin, and fails where
    it lies outside. "Better than the best of them" is a claim about every one: estimate and interval are then those of
    the contrast that decides, and the test is an intersection-union test, which picks nothing from what it tests.

    Args:
        claims: the family.
        rows: one for each episode, with `seed` (the scene), `arm`, `bias` and the metrics.
        level: of confidence.
        seed: of the resampling.
    """
    found = [_contrasts(claim, rows) for claim in claims]
    tested = {k: _tested(claim, found[k], seed) for k, claim in enumerate(claims) if found[k]}
    corrected = dict(
        zip(tested, holm(torch.tensor([p for _, p, _ in tested.values()], dtype=torch.float64)).tolist(), strict=True)
    )
    verdicts = []
    for k, claim in enumerate(claims):
        if k not in tested:
            verdicts.append(Verdict("undecided", None, None, None, None, None, None, _scenes(claim, rows)))
            continue
        d, p, ahead = tested[k]
        estimate, low, high = (float(x) for x in bootstrap_interval(d, torch.Generator().manual_seed(seed), level))
        spread = float(d.std())
        if claim.sign == "equal":
            inside = -claim.margin <= low and high <= claim.margin
            outside = low > claim.margin or high < -claim.margin
            verdict = "holds" if inside else "fails" if outside else "undecided"
        elif corrected[k] > 1 - level:
            verdict = "undecided"
        else:
            verdict = "holds" if ahead else "fails"
        size = estimate / spread if spread > 0 else None
        verdicts.append(Verdict(verdict, estimate, low, high, size, p, corrected[k], len(d)))
    return verdicts


def _scenes(claim: Claim, rows: Sequence[Row]) -> int:
    return len(_by_scene(rows, claim.metric, claim.plus))
