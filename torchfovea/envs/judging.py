"""What an environment tells of its searches beside the observations: the paper's metrics, for who trains and judges."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from torchfovea.envs.actions import action_mask
from torchfovea.envs.rows import SearchRows
from torchfovea.metrics import gap, regret, saccades_to_target

__all__ = ["EPISODE_METRICS", "infos_of", "metrics_of"]

# of a whole episode, as `torchfovea search` has them; what nobody knows (of a robot) is left out
EPISODE_METRICS = (
    "gap_final", "gap_per_saccade", "regret_per_saccade", "global_information_per_saccade",
    "local_information_per_saccade", "saccades_to_target", "found", "target_error_m", "degrees_travelled",
    "motor_seconds",
)  # fmt: skip


def infos_of(rows: SearchRows, some: list[int]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Of some rows now: each name's values (K, ...) and for which rows they are known, bool (K,)."""
    now = rows.time[some][:, None]
    course = rows.course[some]
    known = {
        "range_m": -course.gather(1, now)[:, 0],
        "gap": gap(course.nan_to_num(nan=-rows.far_m), -rows.nearest[some])[:, -1],
        "global_information": rows.known[some].gather(1, now)[:, 0],
        "local_information": rows.locally[some].gather(1, now)[:, 0],
        "degrees_travelled": rows.travelled[some],
    }
    found = {name: _where_known(values) for name, values in known.items()}
    judged = rows.judged[some].numpy()
    found["on_target"] = rows.hit[some].gather(1, now)[:, 0].numpy(), judged
    if rows.settings.action == "cell":
        found["action_mask"] = action_mask(rows, some), np.ones(len(some), bool)
    return found


def metrics_of(rows: SearchRows, some: list[int]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Of episodes that ended: `EPISODE_METRICS`, and for which rows each is known. Heads stay until T."""
    time, steps = rows.time[some][:, None], torch.arange(rows.settings.saccades)
    last = torch.minimum(steps, time)  # (K, T)
    course, hit = rows.course[some].gather(1, last), rows.hit[some].gather(1, last)
    nats, locally = rows.known[some].gather(1, last), rows.locally[some].gather(1, last)
    best, judged = -rows.nearest[some], rows.judged[some]
    gaps = torch.where(judged[:, None], gap(course.nan_to_num(nan=-rows.far_m), best), torch.nan)

    def if_judged(values: Tensor) -> Tensor:
        return torch.where(judged, values.double(), torch.nan)

    values = (
        gaps[:, -1], gaps.mean(-1), regret(course, best).mean(-1), nats.mean(-1), locally.mean(-1),
        if_judged(saccades_to_target(hit)), if_judged(hit.any(-1)), _target_errors(rows, some), rows.travelled[some],
        rows.seconds[some],
    )  # fmt: skip
    return {name: _where_known(value) for name, value in zip(EPISODE_METRICS, values, strict=True)}


def _target_errors(rows: SearchRows, some: list[int]) -> Tensor:
    """Distance from the best seen eligible cell's mean to the truth [m], (K,); NaN where there is none."""
    step = rows.step
    among = (step.eligible & (rows.memory.looks > 0))[some]
    best = torch.where(among, step.reward.mean[some], -torch.inf).argmax(-1)
    points = step.points.mean[some].gather(1, best[:, None, None].expand(-1, 1, 3))[:, 0].double().cpu()
    truths = [rows.places.truth(row) for row in some]
    nowhere = torch.full((3,), torch.nan, dtype=torch.float64)
    true = torch.stack([nowhere if t is None else t.nearest_point.double().cpu() for t in truths])
    return torch.where(among.any(-1).cpu(), (points - true).norm(dim=-1), torch.nan)


def _where_known(values: Tensor) -> tuple[np.ndarray, np.ndarray]:
    known = torch.isfinite(values).numpy()
    return np.where(known, values.numpy(), 0.0), known
