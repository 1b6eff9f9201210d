"""What an action is: a fixation, a cell or weights over acquisitions; and how it becomes a gaze."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from torch import Tensor

from torchfovea.deciding import strategies
from torchfovea.deciding.strategies import View
from torchfovea.envs.rows import SearchRows
from torchfovea.envs.settings import EnvSettings
from torchfovea.perception import gaze_at
from torchfovea.sensing.head import Gaze, Head
from torchfovea.setting import SettingError, require

__all__ = ["ACQUISITIONS", "action_mask", "action_space", "check_actions", "command", "gazes_of", "weighed"]


def _deviation(view: View) -> Tensor:
    return view.std


def _near(view: View) -> Tensor:
    return (view.directions * view.line_of_sight.unsqueeze(-2)).sum(-1)


# what the weights of an action are over, in this order
ACQUISITIONS: dict[str, Callable[[View], Tensor]] = {
    "mean": lambda view: view.mean,
    "deviation": _deviation,
    "log_ei": strategies.log_expected_improvement,
    "near": _near,
}


def action_space(settings: EnvSettings, cells: int) -> spaces.Space[np.ndarray] | spaces.Discrete:
    """The space of one row's actions.

    `fixation`: (pan, tilt) of [−1, 1], pan positive to the left and tilt positive down, ±1 the head's limits. `cell`:
    the number of a memory's cell. `weights`: of [−1, 1] over `ACQUISITIONS`. Where naming is allowed there is one more
    cell, or one more number, which names the target where it is positive.
    """
    if settings.action == "cell":
        return spaces.Discrete(cells + settings.naming)
    size = 2 if settings.action == "fixation" else len(ACQUISITIONS)
    return spaces.Box(-1.0, 1.0, (size + settings.naming,), np.float32)


def check_actions(space: spaces.Space, actions: object) -> np.ndarray:  # type: ignore[type-arg]
    """Actions as an array, inside their space.

    Raises:
        SettingError: for another shape, NaN, or values outside the space.
    """
    try:
        given = np.asarray(actions)
        whole = isinstance(space, spaces.Discrete | spaces.MultiDiscrete)
        kind = given.dtype.kind
        good = kind in "iu" or (not whole and kind == "f")
        require(good, "action", f"an array of {given.dtype}", f"one of {space.dtype}")
    except (ValueError, TypeError) as error:
        raise SettingError(f"action = {actions!r}: expected an element of {space} ({error})") from error
    require(given.shape == space.shape, "action.shape", given.shape, str(space.shape))
    require(bool(np.isfinite(given).all()), "action", "NaN or infinite", f"an element of {_short(space)}")
    taken = given.astype(space.dtype)
    low, high = float(given.min(initial=0)), float(given.max(initial=0))
    require(bool(space.contains(taken)), "action", f"values from {low:g} to {high:g}", f"an element of {_short(space)}")
    return taken


def _short(space: spaces.Space) -> str:  # type: ignore[type-arg]
    if isinstance(space, spaces.Discrete):
        return f"0 to {space.n - 1}"
    if isinstance(space, spaces.MultiDiscrete):
        return f"0 to {int(space.nvec.flat[0]) - 1}"
    assert isinstance(space, gymnasium.spaces.Box)
    return f"[{space.low.flat[0]:g}, {space.high.flat[0]:g}]"


def command(head: Head, action: Tensor) -> tuple[Tensor, Tensor]:
    """Pan and tilt [rad] of actions (..., 2 or more) in [−1, 1]."""
    pan = action[..., 0] * math.radians(head.pan_limit_deg)
    up, down = math.radians(head.tilt_up_deg), math.radians(head.tilt_down_deg)
    tilt = action[..., 1]
    return pan, torch.where(tilt < 0, tilt * up, tilt * down)


def gazes_of(rows: SearchRows, some: list[int], actions: np.ndarray) -> tuple[Gaze, Tensor]:
    """Where some rows' actions (K, ...) turn the heads, and which name the target instead, bool (K,).

    A fixation's vergence is that of the cell whose own gaze is nearest: the eyes meet where the surface is believed to
    be. A cell out of reach is looked at as far as the head turns.
    """
    settings, like = rows.settings, rows.cells
    never = torch.zeros(len(some), dtype=torch.bool)
    if settings.action == "cell":
        chosen = torch.as_tensor(actions, dtype=torch.int64)
        named = chosen == len(rows.cells) if settings.naming else never
        chosen = torch.where(named, 0, chosen).to(like.device)
        return gaze_at(Gaze(*(angle[some] for angle in rows.aims())), chosen), named
    values = torch.as_tensor(actions, dtype=like.dtype, device=like.device)
    named = (values[:, -1] > 0).cpu() if settings.naming else never
    if settings.action == "weights":
        blend = partial(weighed, weights=values[:, : len(ACQUISITIONS)])
        return rows.decided(some, blend), named
    pan, tilt = command(rows.observer.head, values)
    aims = Gaze(*(angle[some] for angle in rows.aims()))
    nearest = ((aims.pan - pan[:, None]).square() + (aims.tilt - tilt[:, None]).square()).argmin(-1)
    return Gaze(pan, tilt, aims.vergence.gather(-1, nearest[:, None])[:, 0]), named


def weighed(view: View, weights: Tensor) -> Tensor:
    """Acquisitions, each brought to mean 0 and deviation 1 over the eligible cells, and weighed: (..., N)."""
    count = view.eligible.sum(-1, keepdim=True).clamp(min=1)
    total = torch.zeros_like(view.mean)
    for k, acquisition in enumerate(ACQUISITIONS.values()):
        score = acquisition(view)
        score = torch.where(torch.isfinite(score) & view.eligible, score, 0.0)
        mean = score.sum(-1, keepdim=True) / count
        spread = torch.where(view.eligible, score - mean, 0.0)
        deviation = (spread.square().sum(-1, keepdim=True) / count).sqrt()
        total = total + weights[..., k, None] * spread / deviation.clamp(min=1e-9)
    return total


def action_mask(rows: SearchRows, some: list[int]) -> np.ndarray:
    """Which cells are within reach, far enough and no floor: int8 (K, Nx), with one for naming where that is allowed.

    It is for `action=cell`; the other actions are always possible.
    """
    mask = rows.step.eligible[some].to(torch.int8).cpu().numpy()
    return np.pad(mask, ((0, 0), (0, 1)), constant_values=1) if rows.settings.naming else mask
