"""What `sense` asks of a pair before it believes it, and of a foreign disparity before it writes its points."""

from __future__ import annotations

import importlib.util
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.commands.shared.pairs import Pair
from torchfovea.stereo.health import (
    Fault,
    disparity_faults,
    geometry_faults,
    heed,
    picture_faults,
    placeholders,
)
from torchfovea.stereo.sparse import SparseMatches, match_sparse
from torchfovea.stereo.views import Views

__all__ = ["Examined", "examine", "examine_map"]


class Examined(NamedTuple):
    """What is known of a pair before it is sensed.

    Attributes:
        rows_px: how far the rows of sure matches are apart [image px].
        matches: the sure matches; None: not asked for.
        disparity: the truth without what stands for nothing; None: there is none, or it cannot be one.
        warnings: a line each.
    """

    rows_px: float
    matches: SparseMatches | None
    disparity: Tensor | None
    warnings: list[str]


def examine(pair: Pair, views: Views, health: str) -> Examined:
    """Ask a pair's files, levels, calibration and truth.

    A truth that cannot be one is no reason to withhold points: it is left out, and they are not judged.

    Raises:
        SettingError: with `health` error, for what would make the points wrong.
    """
    if health == "off":
        return Examined(0.0, None, pair.disparity, [])
    warnings = heed([*pair.faults, *picture_faults(pair.left, pair.right)], health == "error")
    if importlib.util.find_spec("cv2") is None:
        line = "health: not asked on matches: expected OpenCV, which comes with pip install 'torchfovea[stereo]'"
        return Examined(0.0, None, pair.disparity, [*warnings, line])
    matches = match_sparse(views)
    faults, rows_px = geometry_faults(views, matches)
    warnings += heed(faults, health == "error")
    truth = pair.disparity
    if truth is None:
        return Examined(rows_px, matches, None, warnings)
    both = truth if pair.seen is None else torch.where(pair.seen, truth, torch.nan)
    wrong = disparity_faults(both, matches, "disparity")
    warnings += [f"{fault.line}{'; the points are not judged by it' * (health == 'error')}" for fault in wrong]
    if wrong and health == "error":
        return Examined(rows_px, matches, None, warnings)
    stands, some = placeholders(truth, views.doffs_px, "disparity") if not wrong else (None, [])
    if stands is not None:
        truth = torch.where(stands, torch.nan, truth)
    return Examined(rows_px, matches, truth, warnings + heed(some, False))


def examine_map(disparity: Tensor, valid: Tensor, matches: SparseMatches, views: Views, health: str) -> list[str]:
    """Ask the disparity of a foreign matcher (H, W), by the sure matches of a rectified pair.

    Returns:
        Warnings, a line each.

    Raises:
        SettingError: with `health` error, for disparities in other units, of another sign or pair, or with numbers that
            stand for nothing.
    """
    told = torch.where(valid, disparity, torch.nan).to(matches.left_px)
    faults = disparity_faults(told, matches, "matcher.source")
    if not faults:
        _, faults = placeholders(told, views.doffs_px, "matcher.source")
        faults = [Fault(fault.kind, fault.line.removesuffix("; taken for that"), True) for fault in faults]
    return heed(faults, health == "error")
