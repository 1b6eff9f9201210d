"""One search as a Gymnasium environment."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import torch

from torchfovea.envs.actions import action_space, check_actions, gazes_of
from torchfovea.envs.judging import infos_of, metrics_of
from torchfovea.envs.observations import map_index, observation_space, observations
from torchfovea.envs.pictures import draw_rows, show
from torchfovea.envs.rows import SearchRows
from torchfovea.envs.settings import env_settings
from torchfovea.search import Robot
from torchfovea.setting import require

__all__ = ["RENDER_MODES", "VisualSearchEnv"]

RENDER_MODES = ("rgb_array", "human")
_ROW = [0]


class VisualSearchEnv(gymnasium.Env[Any, Any]):
    """Where to look next: find the nearest object of a scene by saccades, with a memory of calibrated Gaussians.

    `info` holds range_m, gap, on_target, global_information, local_information and degrees_travelled, with action=cell
    the `action_mask` besides, and at an episode's end `metrics` (`torchfovea.envs.judging.EPISODE_METRICS`).

    Args:
        render_mode: `rgb_array`, `human` (a matplotlib window) or None.
        robot: searches in place of a simulated scene; one that cannot tell the truth is rewarded for information and
            cost only.
        device: of the memory and the geometric sensor.
        **settings: see `torchfovea.envs.settings.EnvSettings`.

    Raises:
        SettingError: for settings that cannot be; from `step` for an action outside the space, or none that began.
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES), "render_fps": 4}  # noqa: RUF012

    def __init__(
        self,
        render_mode: str | None = None,
        robot: Robot | None = None,
        device: torch.device | str = "cpu",
        **settings: Any,
    ) -> None:
        require(render_mode in (None, *RENDER_MODES), "render_mode", render_mode, "rgb_array, human or None")
        self.render_mode, self.settings = render_mode, env_settings(settings)
        self.rows = SearchRows(self.settings, 1, device, None if robot is None else [robot])
        self.observation_space: Any = observation_space(self.settings, self.rows.observer, self.rows.fields)
        self.action_space = action_space(self.settings, len(self.rows.cells))
        self._index = map_index(self.rows.cells, self.rows.observer.head, self.settings.map_shape)
        self._running = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begin an episode; the same seed gives the same scene and the same noise. There are no options."""
        super().reset(seed=seed)
        self.rows.begin(_ROW, [int(self.np_random.integers(2**62))])
        self._running = True
        return self._observation(), self._info()

    def step(self, action: Any) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """One saccade, and a look."""
        require(self._running, "step", "no episode", "reset() before it")
        taken = check_actions(self.action_space, action)
        gaze, named = gazes_of(self.rows, _ROW, taken[None])
        outcome = self.rows.advance(_ROW, gaze, named)
        terminated, truncated = bool(outcome.terminated[0]), bool(outcome.truncated[0])
        info = self._info()
        if terminated or truncated:
            self._running = False
            info["metrics"] = _one(metrics_of(self.rows, _ROW))
        return self._observation(), float(outcome.reward[0]), terminated, truncated, info

    def render(self) -> np.ndarray | None:
        """What is known as a picture (H, W, 3) uint8; with `human` it is shown."""
        if self.render_mode is None:
            return None
        picture = draw_rows(self.rows, _ROW, self._index)[0]
        if self.render_mode == "human":
            show(picture)
            return None
        return picture

    def _observation(self) -> dict[str, np.ndarray]:
        return {name: values[0] for name, values in observations(self.rows, _ROW, self._index).items()}

    def _info(self) -> dict[str, Any]:
        return _one(infos_of(self.rows, _ROW))


def _one(found: dict[str, tuple[np.ndarray, np.ndarray]]) -> dict[str, Any]:
    """What is known of the only row."""
    plain = {name: values[0] for name, (values, known) in found.items() if known[0]}
    return {name: value.item() if np.ndim(value) == 0 else value for name, value in plain.items()}
