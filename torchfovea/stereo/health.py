"""Whether a pair of pictures can be what it is said to be, before any number that follows from it is trusted.

Pictures are asked for their levels; calibration, truth and foreign disparities are held against a few hundred sure
matches (`torchfovea.stereo.sparse`) that believe none of them. Every fault is one `Fault` of one line. Rows that are
apart by less than what must be an error become a term of the budget (`misaligned`), so that covariances stay honest.
Nothing here is differentiable.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.sensing.camera import Camera
from torchfovea.sensing.correspondence import Budget
from torchfovea.setting import SettingError
from torchfovea.stereo.sparse import SparseMatches
from torchfovea.stereo.views import Views, grey_of

__all__ = [
    "ROWS_PX",
    "Fault",
    "disparity_faults",
    "full_scale",
    "geometry_faults",
    "heed",
    "misaligned",
    "picture_faults",
    "placeholders",
    "rows_apart_px",
]

ROWS_PX = 1.5
"""Rows that are further apart than this are an error [image px]: matchers lose surfaces, and errors are no longer small
beside a window."""

ROWS_NOTED_PX = 0.5
FEWEST = 20  # matches that tell anything
DARK, BRIGHT = 4 / 255, 254 / 255
SATURATED = 0.25  # share of the pixels
LEVELS = 32
GAIN = 1.6
AGREE = 0.5  # share of the matches, of which a tenth at depth edges is off


class Fault(NamedTuple):
    """What is wrong.

    Attributes:
        kind: a short name.
        line: one line: setting, what was found, what was expected.
        serious: whether the results would be wrong, and not only worse.
    """

    kind: str
    line: str
    serious: bool


def heed(faults: Sequence[Fault], strictly: bool) -> list[str]:
    """The lines of faults, to be told.

    Raises:
        SettingError: if `strictly`, with the line of the first serious one.
    """
    for fault in faults:
        if strictly and fault.serious:
            raise SettingError(f"{fault.line} (health=warn goes on)")
    return [fault.line for fault in faults]


def full_scale(peak: float, nominal: float) -> float:
    """The level that stands for 1 in numbers of which the greatest is `peak`.

    Cameras of 10, 12 or 14 bits are stored in 16, and floating point often in the units of the bytes that it was.

    Args:
        peak: the greatest level of all images that belong together.
        nominal: what their type says: 255, 65535, or 1 for floating point.

    Returns:
        `nominal`, unless the peak is above it or leaves two bits of 16 unused: then that of the fewest bits, of an even
        number from 8 to 16, that hold the peak.
    """
    fits = peak <= nominal * (1 + 1e-3)
    if fits and not (nominal == 2**16 - 1 and peak < 2**14):
        return nominal
    bits = max(8, 2 * math.ceil(math.log2(max(peak, 1.0) + 1) / 2))
    return float(2**bits - 1) if bits <= 16 else nominal


@torch.no_grad()
def picture_faults(left: Tensor, right: Tensor) -> list[Fault]:
    """What the levels of two images (1 or 3, H, W) in [0, 1] tell."""
    found = []
    flats = []
    for name, image in (("left", left), ("right", right)):
        grey = grey_of(image.float()).flatten()
        grey = grey[:: max(1, grey.numel() // 100_000)]
        flats.append(grey)
        if float(grey.median()) < DARK:
            line = f"{name}: half of the picture is darker than 4 of 255 levels: expected one that is exposed"
            found.append(Fault("dark", line, False))
        if (white := float((grey >= BRIGHT).double().mean())) > SATURATED:
            line = f"{name}: {white:.0%} of the picture is white: expected one that is not saturated"
            found.append(Fault("saturated", line, False))
        few = len(
            (image[image.shape[0] // 2].flatten()[:: max(1, image[0].numel() // 100_000)] * 1023).round().unique()
        )
        if few < LEVELS:
            line = f"{name}: {few} grey levels: expected at least {LEVELS} (bits lost, or no texture)"
            found.append(Fault("levels", line, False))
    one, other = (max(float(grey.mean()), 1e-6) for grey in flats)
    if not 1 / GAIN <= one / other <= GAIN:
        line = f"right: the left picture is {one / other:.2g} times as bright: expected one exposure for both"
        found.append(Fault("exposure", line, False))
    if left.shape == right.shape and bool((left == right).all()) and float(flats[0].std()) > 1e-3:
        found.append(Fault("same", "right: the same picture as left: expected the other eye's", True))
    return found


@torch.no_grad()
def rows_apart_px(views: Views, matches: SparseMatches) -> tuple[float, Tensor]:
    """How far the rows of matches are apart in the rectified frame that the calibration claims.

    Args:
        views: the images with their cameras.
        matches: at least one.

    Returns:
        Root mean square of a smooth field (constant, linear, bilinear, and linear in disparity) that is fitted robustly
        to what the matches show, less what their noise makes of it [image px]; and the disparity (M,), `doffs`
        included [image px].
    """
    focal = views.camera_left.focal_px
    left, right = _slopes(views, matches)
    shift, rows = (left - right).mul(focal).unbind(-1)
    shift, rows = shift.double(), -rows.double()
    x, y = left.double().unbind(-1)
    basis = torch.stack([torch.ones_like(x), *(_standard(v) for v in (x, y, x * y, shift))], -1)
    if len(rows) <= 2 * basis.shape[-1]:
        return float(rows.median().abs()), shift
    weight = torch.ones_like(rows)
    field, spread = torch.zeros_like(rows), torch.zeros(())
    for _ in range(15):  # reweighted least squares, Tukey's weights
        scaled = basis * weight[:, None]
        normal = scaled.mT @ basis + 1e-6 * len(rows) * torch.eye(basis.shape[-1], dtype=basis.dtype)
        field = basis @ torch.linalg.solve(normal, scaled.mT @ rows)
        spread = 1.4826 * (rows - field).abs().median() + 1e-3
        weight = (1 - ((rows - field) / (4.7 * spread)).square()).clamp(min=0).square()
    noise = spread.square() * basis.shape[-1] / weight.sum().clamp(min=1)
    square = (weight * field.square()).sum() / weight.sum().clamp(min=1)
    return float((square - noise).clamp(min=0).sqrt()), shift


@torch.no_grad()
def geometry_faults(views: Views, matches: SparseMatches) -> tuple[list[Fault], float]:
    """What sure matches say of the calibration.

    Returns:
        The faults, and how far the rows are apart [image px] (`rows_apart_px`); 0 where too few matches tell.
    """
    count = len(matches.left_px)
    if matches.tried >= 5 * FEWEST and count < FEWEST:
        line = (
            f"right: only {count} of {matches.tried} corners of the left picture are found in it: expected the other "
            "eye's view of the same moment, upright and near the same rows"
        )
        # raw cameras may be turned as far as they like: their rows are only not checked
        return [Fault("unlike", line, views.rectified)], 0.0
    if count < FEWEST:
        return [], 0.0
    found = []
    rows_px, shift = rows_apart_px(views, matches)
    beyond = float((shift < -1 - rows_px).double().mean())
    if beyond > SATURATED:
        line = (
            f"left, right: {beyond:.0%} of {count} sure matches lie beyond infinity (x_left - x_right + doffs_px < 0): "
            "expected the left eye's picture as left, and this pair's doffs_px"
        )
        found.append(Fault("swapped", line, True))
    if rows_px > ROWS_NOTED_PX:
        apart = f"left, right: the rows of {count} sure matches are {rows_px:.2g} px apart"
        expected = f"expected a rectified pair and a calibration that is not stale (at most {ROWS_PX:g} px)"
        worse = "standard deviations are widened by it"
        serious = rows_px > ROWS_PX
        found.append(Fault("rows", f"{apart}: {expected if serious else worse}", serious))
    return found, rows_px


def misaligned(budget: Budget, rows_px: float) -> Budget:
    """The budget of a pair whose rows are so far apart [image px].

    A matcher that looks a little beside the row finds the texture there: where edges are slanted, its disparity errs by
    rows · cot(slant), with as many edges one way as the other: by about as much as the rows are apart. The error is a
    match's, and adds to `Budget.match_px`.
    """
    return replace(budget, match_px=math.hypot(budget.match_px, rows_px))


@torch.no_grad()
def disparity_faults(disparity: Tensor, matches: SparseMatches, setting: str) -> list[Fault]:
    """Whether a disparity map of a rectified pair is what sure matches show.

    Args:
        disparity: (H, W) [image px], not finite where unknown.
        matches: of the same images.
        setting: the map's name.
    """
    column, row = matches.left_px.round().long().unbind(-1)
    height, width = disparity.shape
    told = disparity[row.clamp(0, height - 1), column.clamp(0, width - 1)].double()
    shown = (matches.left_px - matches.right_px)[:, 0].double()
    known = torch.isfinite(told) & (told != 0) & (shown.abs() > 4)
    told, shown = told[known], shown[known]
    if len(told) < FEWEST or _agree(told, shown) >= AGREE:
        return []
    ratio = float((told / shown).median())
    if _agree(told / ratio, shown) >= AGREE:
        what = f"{ratio:.3g} times what {len(told)} sure matches of the pictures show"
        if abs(ratio + 1) < 0.1:
            what += ", the other sign"
        elif abs(ratio) > 1.5:
            what += f", units of 1/{abs(ratio):.3g} px"
        return [Fault("units", f"{setting}: {what}: expected x_left - x_right in pixels of these images", True)]
    share = _agree(told, shown)
    line = (
        f"{setting}: only {share:.0%} of {len(told)} sure matches of the pictures agree with it: expected this pair's"
    )
    return [Fault("foreign", f"{line} x_left - x_right in pixels", True)]


@torch.no_grad()
def placeholders(disparity: Tensor, doffs_px: float, setting: str) -> tuple[Tensor, list[Fault]]:
    """Numbers of a disparity map that stand for nothing: 0, a repeated negative one, and what lies beyond infinity.

    Args:
        disparity: (H, W) [px], not finite where unknown.
        doffs_px: disparity of a point at infinity, negated.
        setting: the map's name.

    Returns:
        bool (H, W), where they stand, and the fault.
    """
    finite = torch.isfinite(disparity)
    none = torch.zeros_like(finite)
    low = disparity[finite & (disparity <= 0)]
    if not len(low):
        return none, []
    values, counts = low.unique(return_counts=True)
    often = values[counts > max(1e-3 * float(finite.sum()), 1)]
    repeated = finite & torch.isin(disparity, often)
    stands = repeated | (finite & (disparity + doffs_px < -1))
    if not bool(stands.any()):
        return none, []
    which = ", ".join(f"{v:g}" for v in often[:3].tolist()) or "what lies beyond infinity"
    share = float(stands.double().sum() / finite.sum())
    line = f"{setting}: {share:.1%} of it is {which}: expected NaN where it is unknown; taken for that"
    return stands, [Fault("placeholder", line, False)]


def _agree(told: Tensor, shown: Tensor) -> float:
    return float(((told - shown).abs() <= (0.1 * shown.abs()).clamp(min=1.5)).double().mean())


def _slopes(views: Views, matches: SparseMatches) -> tuple[Tensor, Tensor]:
    """x/z and y/z (M, 2) of both eyes' matches in the rectified frame."""

    def slope(camera: Camera, px: Tensor, R: Tensor) -> Tensor:
        ray = camera.rays(px.double()) @ R.to(px.device, torch.float64).mT
        return ray[:, :2] / ray[:, 2:].clamp(min=1e-6)

    return (
        slope(views.camera_left, matches.left_px, views.rig.R_left),
        slope(views.camera_right, matches.right_px, views.rig.R_right),
    )


def _standard(values: Tensor) -> Tensor:
    """About 0 and of order 1; what lies far out has no leverage."""
    away = values - values.median()
    return (away / (1.4826 * away.abs().median()).clamp(min=1e-9)).clamp(-3, 3)
