"""The health of a pair: every planted fault is found by its name, and clean pairs pass."""

import math
from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
import pytest
import torch

from torchfovea.commands.shared.pairs import motorcycle
from torchfovea.sensing.correspondence import Budget
from torchfovea.setting import SettingError
from torchfovea.stereo.health import (
    disparity_faults,
    full_scale,
    geometry_faults,
    misaligned,
    picture_faults,
    placeholders,
    rows_apart_px,
)
from torchfovea.stereo.sparse import match_sparse
from torchfovea.stereo.views import posed_views, rectified_views


@lru_cache
def pair():
    return motorcycle()


@lru_cache
def part():
    """A part of it, to plant faults in."""
    whole, window = pair(), (..., slice(80, 420), slice(100, 600))
    return whole._replace(
        left=whole.left[window].contiguous(), right=whole.right[window].contiguous(), disparity=whole.disparity[window]
    )


def views_of(left=None, right=None):
    whole = pair()
    whole = whole if left is None or left.shape == whole.left.shape else part()
    return whole._replace(
        left=whole.left if left is None else left, right=whole.right if right is None else right
    ).views(None)


@lru_cache
def clean():
    """The motorcycle with its matches."""
    views = views_of()
    return views, match_sparse(views)


def warped(image, matrix):
    """An image (3, H, W) through an affine map (2, 3), by OpenCV."""
    array = image.movedim(0, -1).numpy()
    size = array.shape[1::-1]
    moved = cv2.warpAffine(array, np.float32(matrix), size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return torch.from_numpy(moved).movedim(-1, 0).clamp(0, 1)


def kinds(views, truth=None):
    matches = match_sparse(views)
    found = [*picture_faults(views.left, views.right), *geometry_faults(views, matches)[0]]
    if truth is not None:
        found += disparity_faults(truth, matches, "disparity")
        found += placeholders(truth, views.doffs_px, "disparity")[1]
    return {fault.kind for fault in found}


def test_sparse_matches_are_true():
    _, matches = clean()
    column, row = matches.left_px.round().long().unbind(-1)
    truth = pair().disparity[row, column]
    error = ((matches.left_px - matches.right_px)[:, 0] - truth).abs()[torch.isfinite(truth)]
    assert len(error) > 150 and error.median() < 0.3 and (error < 2).double().mean() > 0.9


@pytest.mark.parametrize(
    ("matrix", "law"),
    [
        ([[1, 0, 0], [0, 1, 0.8]], lambda x, y: 0.8 + 0 * x),
        ([[1, 0, 0], [0, 1, -4]], lambda x, y: -4 + 0 * x),
        ([[1, 0, 0], [0.01, 1, -3]], lambda x, y: 0.01 * x - 3),
        ([[1, 0, 0], [0, 1.012, -2]], lambda x, y: 0.012 * y - 2),
    ],
)
def test_rows_are_apart_by_what_was_planted(matrix, law):
    """Root mean square over the matches of the map that moved the right picture's rows."""
    views = views_of(right=warped(pair().right, matrix))
    matches = match_sparse(views)
    planted = law(*matches.left_px.double().unbind(-1)).square().mean().sqrt()
    assert rows_apart_px(views, matches)[0] == pytest.approx(float(planted), abs=0.15)


def test_rows_are_those_of_the_frame_that_the_calibration_claims():
    """A right picture that is moved, and a right camera that says so: nothing is apart."""
    whole = pair()
    moved = warped(whole.right, [[1, 0, 0], [0, 1, 5]])
    views = whole.views(None)
    tilted = replace(views.camera_right, cy_px=views.camera_right.cy_px + 5)
    told = posed_views(whole.left, moved, views.camera_left, tilted, views.rig)
    faults, rows = geometry_faults(told, match_sparse(told))
    assert not faults and rows < 0.2
    assert {f.kind for f in geometry_faults(views_of(right=moved), match_sparse(told))[0]} == {"rows"}


def test_a_slight_misalignment_is_a_term_of_the_budget():
    budget = Budget(match_px=0.3)
    assert misaligned(budget, 0.4) == replace(budget, match_px=0.5)
    assert misaligned(budget, 0.0) == budget


@pytest.mark.parametrize(
    ("peak", "nominal", "scale"),
    [
        *[(200, 255, 255), (4095, 65535, 4095), (3900, 65535, 4095), (1000, 65535, 1023), (60000, 65535, 65535)],
        *[(16383, 65535, 16383), (16384, 65535, 65535), (0.9, 1, 1), (1.0005, 1, 1), (255, 1, 255), (65535, 1, 65535)],
    ],
)
def test_full_scale(peak, nominal, scale):
    assert full_scale(peak, nominal) == scale


def test_clean_pairs_pass():
    """Crops, exposures that differ a little, and noise."""
    whole, generator = pair(), torch.Generator().manual_seed(0)
    for k, (top, left, side) in enumerate([(0, 0, 500), (0, 241, 500), (100, 120, 380), (60, 300, 400)]):
        window = (..., slice(top, top + side), slice(left, left + side))
        one, other, truth = whole.left[window], whole.right[window], whole.disparity[window]
        noise = [0.01 * k * torch.randn(one.shape, generator=generator) for _ in range(2)]
        one, other = (one + noise[0]).clamp(0, 1), ((1 - 0.08 * k) * other + noise[1]).clamp(0, 1)
        cameras = [
            replace(c, cx_px=c.cx_px - left, cy_px=c.cy_px - top) for c in (whole.camera_left, whole.camera_right)
        ]
        assert kinds(rectified_views(one, other, *cameras, whole.baseline_m), truth) == set(), k


def planted():
    """Kind of fault, the images, and a truth."""
    left, right, truth = part().left, part().right, part().disparity
    whole = torch.where(torch.isfinite(truth), truth, torch.nan)
    return {
        "unrectified": ("rows", left, warped(right, [[1, 0, 0], [0, 1, 4]]), None),
        "turned": ("rows", left, warped(right, cv2.getRotationMatrix2D((250, 170), 1.5, 1)), None),
        "slightly": ("rows", left, warped(right, [[1, 0, 0], [0, 1, 0.8]]), None),
        "exchanged": ("swapped", right, left, None),
        "upside down": ("unlike", left, right.flip(1), None),
        "mirrored": ("unlike", left, right.flip(2), None),
        "twice": ("same", left, left, None),
        "dark": ("dark", left * 0.02, right * 0.02, None),
        "saturated": ("saturated", (left * 2.5).clamp(0, 1), (right * 2.5).clamp(0, 1), None),
        "exposure": ("exposure", left, right * 0.5, None),
        "bits lost": ("levels", (left * 15).round() / 15, (right * 15).round() / 15, None),
        "other sign": ("units", left, right, -whole),
        "16ths": ("units", left, right, (whole * 16).round()),
        "256ths": ("units", left, right, (whole * 256).round()),
        "another's": ("foreign", left, right, whole.flip(1)),
        "0 for nothing": ("placeholder", left, right, whole.nan_to_num(0)),
        "-1 for nothing": ("placeholder", left, right, whole.nan_to_num(-1)),
        "beyond infinity": ("placeholder", left, right, torch.where(truth > 50, -60 - truth, whole)),
    }


@pytest.mark.parametrize("name", planted())
def test_planted_faults_are_found(name):
    kind, left, right, truth = planted()[name]
    assert kind in kinds(views_of(left, right), truth)


def test_a_fault_is_one_line_that_says_what():
    views, matches = clean()
    (fault,) = disparity_faults(-pair().disparity, matches, "disparity")
    assert fault.serious and "the other sign" in fault.line and fault.line.startswith("disparity: ")
    (fault,) = disparity_faults(16 * pair().disparity, matches, "disparity")
    assert "1/16 px" in fault.line
    stands, (fault,) = placeholders(torch.tensor([[0.0, 0, 5, math.nan], [1, -9, 2, 3]]), 2.0, "truth")
    assert stands.tolist() == [[True, True, False, False], [False, True, False, False]]
    assert not fault.serious and "42.9% of it is 0" in fault.line and "\n" not in fault.line
    assert placeholders(pair().disparity, views.doffs_px, "truth")[1] == []


def test_nothing_is_said_of_what_cannot_be_matched():
    grey = torch.full((3, 60, 80), 0.5)
    views = pair()._replace(left=grey, right=grey).views(None)
    matches = match_sparse(views)
    assert matches.left_px.shape == (0, 2) and geometry_faults(views, matches) == ([], 0.0)
    assert disparity_faults(torch.ones(60, 80), matches, "disparity") == []
    with pytest.raises(SettingError, match=r"left\.shape"):
        match_sparse(views._replace(left=grey[None], right=grey[None]))
