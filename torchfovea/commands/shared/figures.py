"""An episode's figures, as commands tabulate them."""

from __future__ import annotations

from typing import Any

from torchfovea.episode import Episode
from torchfovea.metrics import phantom

__all__ = ["EPISODE_COLUMNS", "episode_row"]

EPISODE_COLUMNS = (
    "episode", "seed", "gap_final", "gap_per_saccade", "regret_per_saccade", "global_information_per_saccade",
    "local_information_per_saccade", "saccades_to_target", "found", "target_error_m", "degrees_travelled",
    "motor_seconds", "seconds_per_saccade", "phantom_share",
)  # fmt: skip


def episode_row(episode: Episode) -> tuple[Any, ...]:
    """An episode's figures, in the order of EPISODE_COLUMNS from gap_final on."""
    local = episode.local_information
    chosen = phantom(episode.aimed_m, episode.range_m)[1 : episode.looks]  # the first gaze is nobody's choice
    return (
        float(episode.gap[-1]), float(episode.gap.mean()), float(episode.regret.mean()),
        float(episode.global_information.mean()), None if local is None else float(local.mean()),
        episode.moves, int(episode.hit.any()), episode.target_error_m, episode.degrees, episode.motor_seconds,
        episode.compute_seconds, float(chosen.double().mean()) if len(chosen) else None,
    )  # fmt: skip
