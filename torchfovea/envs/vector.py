"""B searches as one Gymnasium vector environment: tensors of B rows in one process, not B processes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from torchfovea.envs.actions import action_space, check_actions, gazes_of
from torchfovea.envs.judging import infos_of, metrics_of
from torchfovea.envs.observations import map_index, observation_space, observations
from torchfovea.envs.pictures import draw_rows
from torchfovea.envs.rows import SearchRows
from torchfovea.envs.settings import env_settings
from torchfovea.search import Robot
from torchfovea.setting import require

__all__ = ["VisualSearchVectorEnv"]

Observation = dict[str, np.ndarray]
Found = dict[str, tuple[np.ndarray, np.ndarray]]


class VisualSearchVectorEnv(VectorEnv[Observation, np.ndarray, np.ndarray]):
    """`torchfovea.envs.single.VisualSearchEnv`, B at once: row b with seed s + b is the single one with that seed.

    Each row begins anew by itself, in another scene, as `metadata["autoreset_mode"]` says: NEXT_STEP (the step after an
    episode's last ignores the row's action and returns its first observation) or SAME_STEP (the last step returns it,
    with the episode's own last ones as `final_obs` and `final_info`).

    Args:
        num_envs: B.
        render_mode: `rgb_array` or None.
        autoreset_mode: `NextStep` or `SameStep`, or Gymnasium's constants.
        robots: B of them in place of simulated scenes.
        device: of the memories and the geometric sensor: cpu or cuda.
        **settings: see `torchfovea.envs.settings.EnvSettings`.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": ["rgb_array"], "render_fps": 4, "autoreset_mode": AutoresetMode.NEXT_STEP,
    }  # fmt: skip

    def __init__(
        self,
        num_envs: int = 1,
        render_mode: str | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        robots: Sequence[Robot] | None = None,
        device: torch.device | str = "cpu",
        **settings: Any,
    ) -> None:
        require(render_mode in (None, "rgb_array"), "render_mode", render_mode, "rgb_array or None, for many at once")
        modes = {mode.value: mode for mode in (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP)}
        mode = modes.get(getattr(autoreset_mode, "value", autoreset_mode))
        require(mode is not None, "autoreset_mode", autoreset_mode, "one of " + ", ".join(modes))
        self.same_step = mode is AutoresetMode.SAME_STEP
        self.metadata = {**type(self).metadata, "autoreset_mode": mode}
        self.num_envs, self.render_mode, self.settings = num_envs, render_mode, env_settings(settings)
        self.rows = SearchRows(self.settings, num_envs, device, robots)
        self.single_observation_space = observation_space(self.settings, self.rows.observer, self.rows.fields)
        self.single_action_space = action_space(self.settings, len(self.rows.cells))
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._index = map_index(self.rows.cells, self.rows.observer.head, self.settings.map_shape)
        self._all = list(range(num_envs))
        self._sources: list[np.random.Generator] = []
        self._ended = np.zeros(num_envs, bool)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin an episode in every row, or where `options["reset_mask"]`, bool (B,), says so.

        Args:
            seed: of row b, seed + b; or one for each row; None: the rows go on with the chance that they have.
            options: see above.
        """
        seeds = [seed + b for b in self._all] if isinstance(seed, int | np.integer) else seed
        require(seeds is None or len(seeds) == self.num_envs, "seed", seed, f"a number, or {self.num_envs} of them")
        if not self._sources:
            self._sources = [seeding.np_random(None)[0] for _ in self._all]
        for b, own in enumerate(seeds or ()):
            if own is not None:
                self._sources[b], _ = seeding.np_random(int(own))
        if isinstance(seed, int | np.integer):
            self._np_random, self._np_random_seed = seeding.np_random(int(seed))
        mask = np.ones(self.num_envs, bool)
        if options is not None and "reset_mask" in options:
            mask = np.asarray(options["reset_mask"])
            good = mask.shape == (self.num_envs,) and mask.dtype == bool and bool(mask.any())
            require(good, "options.reset_mask", mask, f"bool ({self.num_envs},), some of it true")
        self._begin(np.flatnonzero(mask).tolist())
        self._ended[mask] = False
        return self._observation(), self._padded(infos_of(self.rows, self._all), self._all)

    def _begin(self, some: list[int]) -> None:
        self.rows.begin(some, [int(self._sources[b].integers(2**62)) for b in some])

    def step(self, actions: np.ndarray) -> tuple[Observation, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One saccade and a look in every row."""
        require(bool(self._sources), "step", "no episode", "reset() before it")
        taken = check_actions(self.action_space, actions)
        live = [b for b in self._all if not self._ended[b]]
        rewards, (terminated, truncated) = np.zeros(self.num_envs), np.zeros((2, self.num_envs), bool)
        if live:
            gaze, named = gazes_of(self.rows, live, taken[live])
            outcome = self.rows.advance(live, gaze, named)
            rewards[live] = outcome.reward.numpy()
            terminated[live], truncated[live] = outcome.terminated.numpy(), outcome.truncated.numpy()
        over = np.flatnonzero(terminated | truncated).tolist()
        begun = np.flatnonzero(self._ended).tolist()
        if begun:
            self._begin(begun)
        metrics = self._padded(metrics_of(self.rows, over), over) if over else None
        final: dict[str, Any] = {}
        if over and self.same_step:
            last = self._padded(infos_of(self.rows, over), over) | {"metrics": metrics, "_metrics": self._at(over)}
            final = {"final_obs": self._finals(over), "_final_obs": self._at(over)}
            final |= {"final_info": last, "_final_info": self._at(over)}
            self._begin(over)
        self._ended = np.zeros(self.num_envs, bool) if self.same_step else terminated | truncated
        info = self._padded(infos_of(self.rows, self._all), self._all) | final
        if metrics is not None and not self.same_step:
            info |= {"metrics": metrics, "_metrics": self._at(over)}
        return self._observation(), rewards, terminated, truncated, info

    def render(self) -> tuple[np.ndarray, ...] | None:
        """What each row knows as a picture (H, W, 3) uint8."""
        return None if self.render_mode is None else tuple(draw_rows(self.rows, self._all, self._index))

    def _observation(self) -> Observation:
        return observations(self.rows, self._all, self._index)

    def _finals(self, some: list[int]) -> np.ndarray:
        """The last observations of some rows, as Gymnasium has them: an array of B objects."""
        found, batch = np.full(self.num_envs, None, dtype=object), observations(self.rows, some, self._index)
        for k, b in enumerate(some):
            found[b] = {name: values[k] for name, values in batch.items()}
        return found

    def _at(self, some: list[int]) -> np.ndarray:
        mask = np.zeros(self.num_envs, bool)
        mask[some] = True
        return mask

    def _padded(self, found: Found, some: list[int]) -> dict[str, Any]:
        """Values of some rows as Gymnasium's vector infos: arrays (B, ...) and `_name`, for whom they are known."""
        info: dict[str, Any] = {}
        for name, (values, known) in found.items():
            whole, mask = np.zeros((self.num_envs, *values.shape[1:]), values.dtype), self._at(some)
            whole[some], mask[some] = values, known
            info[name], info[f"_{name}"] = whole, mask
        return info
