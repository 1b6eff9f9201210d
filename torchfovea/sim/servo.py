"""The physical motor: position servos turn the head in MuJoCo until it rests."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from torchfovea.sensing.head import Gaze, Head
from torchfovea.setting import SettingError, require
from torchfovea.sim.backend import load_mujoco
from torchfovea.sim.head_model import JOINTS
from torchfovea.sim.motor import Moved, turned_deg

__all__ = ["ServoMotor"]


@dataclass
class ServoMotor:
    """Turns the head of a scene's MuJoCo model; nothing is seen until it rests (saccadic suppression).

    A saccade has ended when every joint is within `settled_deg` of its command and slower than `settled_deg_s`, at the
    first of `hold_s` seconds for which that stays true.

    Attributes:
        model: the scene's MjModel.
        settled_deg: largest error of a joint at rest.
        settled_deg_s: largest speed of a joint at rest.
        hold_s: for how long.
        timeout_s: after which the saccade counts as failed.
    """

    model: Any
    settled_deg: float = 0.02
    settled_deg_s: float = 0.5
    hold_s: float = 0.01
    timeout_s: float = 3.0

    def __post_init__(self) -> None:
        """Raise SettingError for thresholds that are not positive."""
        for name in ("settled_deg", "settled_deg_s", "hold_s", "timeout_s"):
            require(getattr(self, name) > 0, f"motor.{name}", getattr(self, name), "more than zero")
        mujoco = load_mujoco()
        self.data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self.data)
        joints = [self.model.joint(name) for name in JOINTS]
        self._q = np.array([int(j.qposadr[0]) for j in joints])
        self._v = np.array([int(j.dofadr[0]) for j in joints])

    def move(self, head: Head, before: Gaze, command: Gaze) -> Moved:
        """Execute a saccade.

        Args:
            head: of the scene.
            before: where the head looks; the mechanism is put there, at rest, if it is elsewhere (after a reset).
            command: where it shall look, within the head's limits.

        Raises:
            SettingError: the head does not come to rest in time.
        """
        mujoco = load_mujoco()
        if np.abs(self.data.qpos[self._q] - _angles(before)).max() > math.radians(self.settled_deg):
            self.data.qpos[self._q], self.data.qvel[:] = _angles(before), 0.0
            mujoco.mj_forward(self.model, self.data)
        goal = _angles(command)
        self.data.ctrl[:] = goal
        start = self.data.time
        step = self.model.opt.timestep
        rested = 0.0
        while rested < self.hold_s:
            if self.data.time - start > self.timeout_s:
                error = math.degrees(np.abs(self.data.qpos[self._q] - goal).max())
                raise SettingError(
                    f"motor.timeout_s = {self.timeout_s}: expected the head at rest by then; it is {error:.3g} deg away"
                )
            mujoco.mj_step(self.model, self.data)
            off = np.abs(self.data.qpos[self._q] - goal).max() > math.radians(self.settled_deg)
            fast = np.abs(self.data.qvel[self._v]).max() > math.radians(self.settled_deg_s)
            rested = 0.0 if off or fast else rested + step
        pan, tilt, left, right = (float(a) for a in self.data.qpos[self._q])
        gaze = Gaze(*(torch.tensor(a, dtype=torch.float64) for a in (pan, tilt, left - right)))
        return Moved(gaze, float(self.data.time - start - rested), turned_deg(head, before, gaze))


def _angles(gaze: Gaze) -> np.ndarray:
    """Joint angles [rad] of a gaze, in the order of JOINTS."""
    pan, tilt, vergence = (float(a) for a in gaze)
    return np.array([pan, tilt, vergence / 2, -vergence / 2])
