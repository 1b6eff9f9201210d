"""The table of docs/cameras.md: OpenCV's raw chessboard pairs, judged by the plane that `cv2.solvePnP` finds.

    python scripts/chessboard.py FOLDER

FOLDER has left*.jpg and right*.jpg (samples/data of OpenCV's repository), and stereo.yml with M1, D1, M2, D2, R and T
in metres, as `cv2.stereoCalibrate` finds them from the corners of squares of 25 mm.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import torch

from torchfovea.commands.sense.points import sense
from torchfovea.commands.shared.budgets import load_budget
from torchfovea.sensing.layout import LogPolar
from torchfovea.stereo.calibration_files import load_calibration
from torchfovea.stereo.matchers import Matcher
from torchfovea.stereo.meeting import right_gaze_px
from torchfovea.stereo.sgbm import SGBM
from torchfovea.stereo.sweep import Sweep
from torchfovea.stereo.views import posed_views

CORNERS, SQUARE_M, SIZE = (9, 6), 0.025, (640, 480)
RETINA, NEAREST_M = LogPolar(8000), 0.15


def corners(path: Path) -> np.ndarray:
    """Inner corners of the board, (54, 1, 2) [px]."""
    grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    found = cv2.findChessboardCorners(grey, CORNERS)[1].reshape(-1, 1, 2)
    return cv2.cornerSubPix(grey, found, (5, 5), (-1, -1), (3, 30, 1e-3)).reshape(-1, 1, 2)


def main(folder: Path) -> None:
    """Print the table's rows."""
    calibration = load_calibration([folder / "stereo.yml"], SIZE)
    lens = calibration.left
    matrix = np.array([[lens.fx_px, 0, lens.cx_px], [0, lens.fy_px, lens.cy_px], [0, 0, 1]])
    board = np.zeros((54, 3), np.float32)
    board[:, :2] = np.mgrid[0 : CORNERS[0], 0 : CORNERS[1]].T.reshape(-1, 2) * SQUARE_M
    rows: dict[str, list[torch.Tensor]] = {}
    for path in sorted(folder.glob("left*.jpg")):
        other = path.with_name(path.name.replace("left", "right"))
        here, there = corners(path), corners(other)
        _, turn, place = cv2.solvePnP(board, here, matrix, np.array(lens.distortion))
        normal = torch.from_numpy(cv2.Rodrigues(turn)[0][:, 2])
        away = normal @ torch.from_numpy(place.reshape(3))
        hull = cv2.convexHull(here)
        middles = [tuple(float(c) for c in found.mean((0, 1))) for found in (here, there)]
        images = [cv2.cvtColor(cv2.imread(str(p)), cv2.COLOR_BGR2RGB).transpose(2, 0, 1) for p in (path, other)]
        cameras = (lens, calibration.right, calibration.rig)
        found = right_gaze_px(posed_views(*images, *cameras, middles[0]), NEAREST_M)
        for gaze, name in ((None, "same pixel"), (found, "found"), (middles[1], "board")):
            views = posed_views(*images, *cameras, middles[0], gaze)
            for params, budget in ((Sweep(), "log_polar_sweep"), (SGBM(), "log_polar_sgbm")):
                matches, _ = Matcher(params, NEAREST_M)(views, RETINA, load_budget(budget, views.source_px))
                sensed = sense(views, RETINA, matches, None, True)
                px = matches.left_px.double() * views.scale(RETINA) + torch.tensor(views.gaze_px)
                on = torch.tensor([cv2.pointPolygonTest(hull, tuple(p), False) > 0 for p in px.tolist()])
                ray = torch.nn.functional.normalize(lens.rays(px), dim=-1)
                true, keep = (ray @ normal) / away, on & sensed.chosen
                error = (sensed.observed.mean[:, 2] - true)[keep]
                score = error / sensed.observed.cov[keep, 5].sqrt()
                row = torch.stack([error / true[keep], score], -1)
                rows.setdefault(f"{name}, {type(params).__name__}", []).append(row)
    for name, parts in rows.items():
        relative, score = torch.cat(parts).abs().unbind(-1)
        print(
            f"{name}: {len(score)} fields, median {relative.median():.4f}, inside {(score < 1.96).double().mean():.3f}"
        )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
