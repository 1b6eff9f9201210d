"""The head as a MuJoCo mechanism: pan, tilt and two eyes that turn in the horizontal plane of the neck."""

from __future__ import annotations

import math
from typing import Any

from torchfovea.sensing.head import Head

__all__ = ["JOINTS", "add_head"]

JOINTS = ("pan", "tilt", "left_eye", "right_eye")
"""Joint names; both eyes turn about the optical y (down), so that vergence = left − right."""

# a servo's natural frequency [rad/s] and the inertia that its gear reflects to the joint [kg m²]
_SERVO = {"pan": (20.0, 0.05), "tilt": (20.0, 0.05), "left_eye": (90.0, 2e-4), "right_eye": (90.0, 2e-4)}
_SPARE_RAD = math.radians(3)  # the mechanism reaches a little past the head's limits


def add_head(spec: Any, head: Head) -> None:
    """Add to an MjSpec the mocap body ``ego`` (the frame E) with the head on it, and the free camera ``view``.

    Servos are position-controlled and critically damped; the neck is gravity-compensated. No geom: nothing of the head
    blocks a ray.
    """
    import mujoco  # the caller holds an MjSpec: MuJoCo is loaded

    spec.compiler.degree = False
    spec.option.timestep = 0.001
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # an actuator has some range, be it none that shows
    pan, up, down, half = (
        max(math.radians(angle), 1e-6)
        for angle in (head.pan_limit_deg, head.tilt_up_deg, head.tilt_down_deg, head.vergence_max_deg / 2)
    )
    limits = {"pan": (-pan, pan), "tilt": (-up, down), "left_eye": (0.0, half), "right_eye": (-half, 0.0)}

    def hinge(body: Any, name: str, axis: tuple[float, float, float]) -> None:
        low, high = limits[name]
        frequency, armature = _SERVO[name]
        body.add_joint(
            name=name, type=mujoco.mjtJoint.mjJNT_HINGE, axis=list(axis), armature=armature,
            range=[low - _SPARE_RAD, high + _SPARE_RAD], limited=mujoco.mjtLimited.mjLIMITED_TRUE,
        )  # fmt: skip
        stiffness, damping = armature * frequency**2, 2 * armature * frequency
        spec.add_actuator(
            name=f"{name}_servo", target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT,
            gaintype=mujoco.mjtGain.mjGAIN_FIXED, gainprm=[stiffness] + [0.0] * 9,
            biastype=mujoco.mjtBias.mjBIAS_AFFINE, biasprm=[0.0, -stiffness, -damping] + [0.0] * 7,
            ctrlrange=[low, high], ctrllimited=mujoco.mjtLimited.mjLIMITED_TRUE,
        )  # fmt: skip

    def link(parent: Any, name: str, pos: list[float], mass: float, inertia: float) -> Any:
        return parent.add_body(
            name=name,
            pos=pos,
            mass=mass,
            inertia=[inertia] * 3,
            ipos=[0.0, 0.0, 0.0],
            explicitinertial=True,
            gravcomp=1.0,
        )

    ego = spec.worldbody.add_body(name="ego", mocap=True, pos=[0.0, 0.0, head.ego_height_m])
    neck = link(ego, "neck", [0.0, 0.0, 0.0], 0.2, 1e-3)
    hinge(neck, "pan", (0.0, 0.0, 1.0))
    skull = link(neck, "skull", [0.0, 0.0, 0.0], 0.6, 2e-3)
    hinge(skull, "tilt", (0.0, 1.0, 0.0))
    for name, side in (("left_eye", 1.0), ("right_eye", -1.0)):
        place = [head.eyes_forward_m, side * head.baseline_m / 2, head.eyes_up_m]
        eye = link(skull, name, place, 0.02, 1e-5)
        hinge(eye, name, (0.0, 0.0, -1.0))
        # MuJoCo's cameras look along −z with y up
        eye.add_camera(name=name, xyaxes=[0.0, -1.0, 0.0, 0.0, 0.0, 1.0], fovy=90.0)
    view = spec.worldbody.add_body(name="view", mocap=True)
    view.add_camera(name="view", xyaxes=[1.0, 0.0, 0.0, 0.0, 1.0, 0.0], fovy=90.0)
