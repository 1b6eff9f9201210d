"""A policy that was trained in the environment as a strategy of `torchfovea.search`, and so of `torchfovea search`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchfovea.deciding.strategies import Strategy, View
from torchfovea.envs.actions import ACQUISITIONS, command, weighed
from torchfovea.envs.observations import Shown, map_index, memory_map
from torchfovea.envs.settings import ACTIONS
from torchfovea.imported import load_function
from torchfovea.memory.egosphere import cartesian_belief, trust
from torchfovea.metrics import information
from torchfovea.perception import Observer
from torchfovea.sensing.head import fixate
from torchfovea.setting import SettingError, require

__all__ = ["Policy", "policy_strategy", "trained"]

Policy = Callable[[dict[str, np.ndarray]], Any]
"""A function of a batch of observations (K, ...) that returns a batch of actions."""

SIZES = {"fixation": 2, "weights": len(ACQUISITIONS)}  # numbers of an action, beside the one that names the target


def policy_strategy(
    policy: Policy, observer: Observer, action: str = "fixation", map_shape: tuple[int, int] = (12, 20)
) -> Strategy:
    """A policy of the environment as a strategy.

    It sees `memory` and `gaze` as the environment shows them. Of a fixation, and of a cell that is not eligible, the
    eligible cell nearest to it is looked at; who names the target looks at the best.

    Args:
        policy: from observations to actions.
        observer: of the search.
        action: what the policy's actions are, see `torchfovea.envs.settings.EnvSettings`.
        map_shape: rows and columns of its map.
    """
    require(action in ACTIONS, "action", action, "one of " + ", ".join(ACTIONS))

    def strategy(view: View) -> tuple[Tensor, Tensor]:
        memory = view.memory
        require(memory is not None, "view.memory", None, "what is known, as torchfovea.perception.decide shows it")
        assert memory is not None
        index = map_index(view.directions, observer.head, map_shape) if view.state is None else view.state
        points = cartesian_belief(memory)
        shown = Shown(points.mean, information(points.cov), trust(memory), view.eligible)
        known = memory_map(shown, index, map_shape)
        lead = view.mean.shape[:-1]
        seen = {"memory": known.reshape(-1, *known.shape[-3:]), "gaze": view.line_of_sight.reshape(-1, 3).float()}
        given = policy({name: value.detach().cpu().numpy() for name, value in seen.items()})
        answer = _checked(given, action, len(seen["gaze"]), view.mean.shape[-1]).to(view.mean.device)
        answer = answer.reshape((*lead, *answer.shape[1:]))
        if action == "cell":
            score, named = _near_cell(view, answer), answer == view.mean.shape[-1]
        else:
            size = SIZES[action]
            named = (answer[..., size:] > 0).any(-1)
            if action == "weights":
                score = weighed(view, answer[..., :size].to(view.mean))
            else:
                aim = fixate(observer.head, points.mean)[0]
                pan, tilt = command(observer.head, answer.to(view.mean).clamp(-1, 1))
                score = -((aim.pan - pan[..., None]).square() + (aim.tilt - tilt[..., None]).square())
        return torch.where(named[..., None], view.mean, score), index

    return strategy


def _checked(given: object, action: str, rows: int, cells: int) -> Tensor:
    """A policy's answer, (rows,) cells or (rows, numbers)."""
    answer = torch.as_tensor(np.asarray(given))
    if action == "cell":
        fits = answer.shape == (rows,) and not answer.is_floating_point()
        require(fits, "policy's actions", f"{tuple(answer.shape)} {answer.dtype}", f"{rows} whole numbers")
        inside = bool(((answer >= 0) & (answer <= cells)).all())
        require(inside, "policy's actions", f"{int(answer.min())} to {int(answer.max())}", f"cells, 0 to {cells - 1}")
        return answer.long()
    size = SIZES[action]
    fits = answer.dim() == 2 and len(answer) == rows and answer.shape[1] in (size, size + 1)
    require(fits, "policy's actions", tuple(answer.shape), f"({rows}, {size})")
    require(bool(answer.isfinite().all()), "policy's actions", "NaN or infinite", "finite numbers")
    return answer


def _near_cell(view: View, cell: Tensor) -> Tensor:
    """How near each cell is to one, as a cosine: (...) to (..., Nx)."""
    last = view.mean.shape[-1] - 1
    at = view.directions.gather(-2, cell.clamp(max=last)[..., None, None].expand(*cell.shape, 1, 3))
    return (view.directions * at).sum(-1)


def trained(
    policy: str, observer: Observer, action: str | None = None, map_shape: tuple[int, int] | None = None
) -> Strategy:
    """The strategy of a policy by its name, as `acquisition=trained` has it.

    Args:
        policy: a file that Stable-Baselines3's PPO saved (FILE.zip), whose spaces say the rest; or `module:function`.
        observer: of the search.
        action: of a function.
        map_shape: of a function.
    """
    named = isinstance(policy, str)
    require(named, "acquisition.policy", policy, "FILE.zip or package.module:function")
    if not policy.endswith(".zip"):
        found: Policy = load_function(policy, "acquisition.policy", "FILE.zip or package.module:function")
        rows, columns = map_shape or (12, 20)
        return policy_strategy(found, observer, action or "fixation", (rows, columns))
    require(Path(policy).is_file(), "acquisition.policy", policy, "an existing FILE.zip")
    from stable_baselines3 import PPO

    try:
        model: Any = PPO.load(policy, device="cpu")
        spaces = model.observation_space.spaces
        _, rows, columns = spaces["memory"].shape
    except (OSError, ValueError, KeyError, AttributeError) as error:
        raise SettingError(f"acquisition.policy = {policy}: expected a PPO that sees a memory ({error})") from error
    numbers = model.action_space.shape
    kind = "cell" if not numbers else "fixation" if numbers[0] <= SIZES["fixation"] + 1 else "weights"

    def answer(seen: dict[str, np.ndarray]) -> Any:
        return model.predict({name: seen[name] for name in spaces}, deterministic=True)[0]

    return policy_strategy(answer, observer, kind, (rows, columns))
