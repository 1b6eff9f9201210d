"""What `torchfovea calibrate` says: figures by region, bins, the table of inlier probabilities, the screen."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any

import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor

from torchfovea.commands.shared.regions import REGIONS
from torchfovea.commands.shared.screen import print_figures
from torchfovea.sensing.correspondence import Budget
from torchfovea.studies.calibration import Judged, inlier_of, judge, reliability, select, sigma_of

__all__ = ["FIGURES", "bins", "print_judgements", "regions_of", "table"]

FIGURES = (
    "nees_mean", "coverage_50", "coverage_90", "coverage_95", "coverage_99", "nll", "outlier_share", "ause",
    "interval_over_error", "inlier_share", "inlier_coverage_50", "inlier_coverage_95", "inlier_mean", "mixture_nll",
)  # fmt: skip
SHOWN = (
    "coverage_50", "coverage_95", "outlier_share", "inlier_mean", "nll", "mixture_nll", "interval_over_error",
)  # fmt: skip
IN_REGIONS = ("coverage_50", "coverage_95", "outlier_share", "inlier_mean", "mixture_nll")
BIN_COLUMNS = (
    "data", "model", "range_from_m", "range_to_m", "eccentricity_from_deg", "eccentricity_to_deg", "observations",
    *FIGURES,
)  # fmt: skip
RELIABILITY_COLUMNS = (
    "data", "model", "inlier_from", "inlier_to", "observations", "inlier_mean_by_area", "within_3_sigma_by_area",
)  # fmt: skip
PROBABILITIES = (0.0, 0.2, 0.4, 0.6, 0.7, 0.8, 0.85, 0.9, 0.95, 1.0)
LEAST_IN_BIN = 50


def regions_of(data: Judged, sigma: Tensor, inlier: Tensor) -> dict[str, float]:
    """Figures by region and area, and the region's share of the area; regions with few observations left out."""
    figures, area = {}, data.area()
    for k, name in enumerate(REGIONS):
        here = data.region == k
        figures[f"{name}.share_by_area"] = float((area * here).sum() / area.sum())
        if int(here.sum()) >= LEAST_IN_BIN:
            found = judge(select(data, here), sigma[here], inlier[here], area[here])
            figures |= {f"{name}.{figure}_by_area": found[figure] for figure in IN_REGIONS}
    return figures


def bins(
    data: Mapping[str, Judged],
    models: Mapping[str, Mapping[str, Budget]],
    ranges: list[float],
    eccentricities: list[float],
) -> tuple[tuple[str, ...], list[tuple[Any, ...]]]:
    """bins.csv, its columns and rows: everything, each range, each eccentricity, each of both; no edge is empty."""
    rows: list[tuple[Any, ...]] = []
    anywhere: list[tuple[float, float] | None] = [None]
    for kind, judged in data.items():
        degrees = torch.rad2deg(judged.eccentricity_rad)
        for low_high in anywhere + list(pairwise(ranges)):
            for inner_outer in anywhere + list(pairwise(eccentricities)):
                mask = _within(judged.range_m, low_high) & _within(degrees, inner_outer)
                part, count = select(judged, mask), int(mask.sum())
                for model, law in models[kind].items():
                    enough = count >= LEAST_IN_BIN
                    found = judge(part, sigma_of(part, law), inlier_of(part, law)) if enough else {}
                    bounds = *(low_high or (None, None)), *(inner_outer or (None, None))
                    rows.append((kind, model, *bounds, count, *(found.get(name) for name in FIGURES)))
    return BIN_COLUMNS, rows


def table(
    data: Mapping[str, Judged], models: Mapping[str, Mapping[str, Budget]]
) -> tuple[tuple[str, ...], list[tuple[Any, ...]]]:
    """reliability.csv, its columns and rows: claimed inlier probabilities and how many lie within 3 σ."""
    rows: list[tuple[Any, ...]] = []
    for kind, judged in data.items():
        for model, law in models[kind].items():
            claims = sigma_of(judged, law), inlier_of(judged, law)
            rows += [(kind, model, *row) for row in reliability(judged, *claims, PROBABILITIES, judged.area())]
    return RELIABILITY_COLUMNS, rows


def print_judgements(figures: Mapping[str, Any], models: Mapping[str, list[str]]) -> None:
    """The most telling figures by area on the screen, a row for each judgement; then the fitted numbers."""
    first = next(iter(models))
    heads = (name.replace("_", " ") for name in SHOWN)
    grid = Table("by area", "", *heads, box=None, padding=(0, 1, 0, 0))  # 80 columns hold it
    for kind, laws in models.items():
        for model in laws:
            prefix = ("" if kind == first else f"{kind}.") + model
            grid.add_row(kind, model, *(f"{figures[f'{prefix}.{name}_by_area']:.3g}" for name in SHOWN))
    Console().print(grid)
    print_figures({name.removeprefix("fit."): figure for name, figure in figures.items() if name.startswith("fit.")})


def _within(values: Tensor, edges: tuple[float, float] | None) -> Tensor:
    if edges is None:
        return torch.ones_like(values, dtype=torch.bool)
    return (values >= edges[0]) & (values < edges[1])
