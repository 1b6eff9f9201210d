"""Observations with truth, drawn from a budget's own law."""

import numpy as np
import torch

from torchfovea.studies.calibration import Judged, inlier_of, sigma_of

LINE = 4.0


def observations(count, budget, seed=0):
    """Errors drawn from a budget's own law: Gaussian, and with 1 - p anywhere on a line."""
    rng = np.random.default_rng(seed)
    spread = {
        "left_gain": rng.uniform(0.01, 0.1, count), "right_gain": rng.uniform(0.01, 0.1, count),
        "left_width_px": rng.uniform(0.1, 4, count), "right_width_px": rng.uniform(0.1, 4, count),
        "line": np.full(count, LINE),
        "pixel_px": np.full(count, 0.5), "bend_px": rng.exponential(2, count) * (rng.random(count) < 0.4),
        "gap_px": rng.exponential(3, count) * (rng.random(count) < 0.3),
        "fringe_px": rng.exponential(2, count) * (rng.random(count) < 0.3), "noise_px": rng.exponential(0.3, count),
        "mismatch": rng.uniform(0, 0.6, count), "hidden_px": rng.exponential(4, count) * (rng.random(count) < 0.2),
        "claim_px": rng.exponential(0.5, count), "range_m": rng.uniform(0.5, 1.5, count),
        "eccentricity_rad": rng.uniform(0, 1, count), "place_px": rng.uniform(-100, 100, (count, 2)),
        "region": np.zeros(count, np.int64),
    }  # fmt: skip
    data = Judged(torch.zeros(count), *(torch.as_tensor(spread[name]) for name in Judged._fields[1:]))
    error = sigma_of(data, budget).numpy() * rng.normal(size=count)
    wild = rng.uniform(-LINE / 2, LINE / 2, count)
    true = rng.random(count) < inlier_of(data, budget).numpy()
    return data._replace(error=torch.as_tensor(np.where(true, error, wild)))


CLUES = ("bend_px", "gap_px", "fringe_px", "noise_px", "mismatch", "hidden_px", "claim_px")


def without_clues(data):
    return data._replace(**{name: torch.zeros_like(data.error) for name in CLUES})
