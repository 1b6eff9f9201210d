"""The simulated world as an agent meets it: it moves its head, gets pictures, and a referee sees the truth."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Literal, NamedTuple

import torch
from torch import Tensor

from torchfovea.sensing.camera import Camera, Pinhole, image_camera
from torchfovea.sensing.head import Gaze, Head, clamp_gaze, cyclopean, eyes, to_ego
from torchfovea.setting import require
from torchfovea.sim.compile import stand_at
from torchfovea.sim.gl import opengl
from torchfovea.sim.model import EgoPose, Scene
from torchfovea.sim.motor import InstantMotor, Motor, Moved
from torchfovea.sim.noise import ImageNoise, expose
from torchfovea.sim.rays import Frame, RayHits, Renderer, cast, render, render_together
from torchfovea.sim.servo import ServoMotor

__all__ = ["Fixated", "Seen", "World", "images_together"]

_TOGETHER_PX = 1 << 18  # of pictures that are drawn at once: more gain nothing


class Fixated(NamedTuple):
    """The first surface on the cyclopean ray.

    Attributes:
        point_e: (3,) in E [m]; far out on the ray for a miss.
        range_m: its distance from E's origin.
        geom: which geom it lies on, -1 for a miss.
        is_floor: whether that is the floor.
        is_target: whether that is the target.
    """

    point_e: Tensor
    range_m: float
    geom: int
    is_floor: bool
    is_target: bool


class Seen(NamedTuple):
    """What the left eye's rays meet, and whether the right eye sees it.

    Attributes:
        points_e: (N, 3) in E [m]; far out on the ray for a miss.
        hit: (N,) bool, whether the left ray meets a surface.
        visible_right: (N,) bool, whether the right eye has a free line of sight to it and it lies before that eye;
            whether it falls on the right retina is the retina's to say.
    """

    points_e: Tensor
    hit: Tensor
    visible_right: Tensor


class World:
    """A scene with a head in it. Keeps two things only: where the head looks, and where the robot stands.

    Args:
        scene: from `torchfovea.sim.scene.build_scene`; its head is this world's.
        head: must equal the scene's; the scene's by default.
        renderer: "rays", "gl" for OpenGL through MuJoCo, or a function (`torchfovea.sim.rays.Renderer`).
        motor: "instant", "physics", or a motor (`torchfovea.sim.motor.Motor`).
        camera: of the retinas, in retinal pixels; 90 degrees over 100 px by default.
        source_px: side of the pictures.
        radius_px: of the retina, which the pictures span.
        noise: of the pictures; None: a repeated gaze is the same picture.
        seed: of that noise.

    Raises:
        SettingError: a setting that cannot be.
    """

    def __init__(
        self,
        scene: Scene,
        head: Head | None = None,
        renderer: Literal["rays", "gl"] | Renderer = "rays",
        motor: Literal["instant", "physics"] | Motor = "instant",
        camera: Camera | None = None,
        source_px: int = 400,
        radius_px: float = 100.0,
        noise: ImageNoise | None = None,
        seed: int = 0,
    ) -> None:
        require(head is None or head == scene.head, "head", head, "the head that the scene was built for")
        drawn = callable(renderer) or renderer in ("rays", "gl")
        require(drawn, "renderer", renderer, "rays, gl or a function (scene, R, t, camera, size_px)")
        require(isinstance(source_px, int) and 2 <= source_px <= 8192, "source_px", source_px, "2 to 8192 pixels")
        require(radius_px > 0, "radius_px", radius_px, "a positive number of pixels")
        self.scene = scene
        self.head = scene.head
        self.camera = Pinhole.from_fov(90.0, radius_px) if camera is None else camera
        self.source_px = source_px
        self.image_camera = image_camera(self.camera, radius_px, source_px)
        if isinstance(renderer, partial) and renderer.func is render and not renderer.args + tuple(renderer.keywords):
            renderer = "rays"  # what a configuration makes of it
        self._render: Renderer = opengl() if renderer == "gl" else render if isinstance(renderer, str) else renderer
        self.motor: Motor
        if motor == "instant":
            self.motor = InstantMotor()
        elif motor == "physics":
            self.motor = ServoMotor(scene.model)
        else:
            moves = callable(getattr(motor, "move", None))
            require(moves, "motor", motor, "instant, physics or a motor that has move(head, before, command)")
            assert not isinstance(motor, str)
            self.motor = motor
        self.noise, self._seed = noise, seed
        self.reset()

    def reset(self) -> None:
        """Look straight ahead, in no time; the pictures' noise begins anew."""
        self._chance = torch.Generator().manual_seed(self._seed)
        self._gains = (1.0, 1.0) if self.noise is None else self.noise.gains(self._chance)
        zero = torch.zeros((), dtype=torch.float64)
        self.gaze = Gaze(zero, zero, zero)

    def stand(self, pose: EgoPose) -> None:
        """Put the robot somewhere else in the world, in no time; the scene's truth is found anew."""
        self.scene = stand_at(self.scene, pose)

    def saccade(self, gaze: Gaze) -> Moved:
        """Turn to a gaze, clamped to the head's limits; the executed gaze is `Moved.gaze` and this world's `gaze`.

        Raises:
            SettingError: a gaze that is not one finite pan, tilt and vergence.
        """
        command = clamp_gaze(self.head, self._one(gaze))
        moved = self.motor.move(self.head, self.gaze, command)
        require(isinstance(moved, Moved), "motor", f"{type(moved).__name__} from move", "a torchfovea.sim.motor.Moved")
        self.gaze = moved.gaze
        return moved

    def images(self, gaze: Gaze | None = None) -> tuple[Frame, Frame]:
        """Left and right pictures at a gaze (the current one by default)."""
        pose = eyes(self.head, self._one(gaze))
        rotations, centres = (pose.R_left, pose.R_right), (pose.t_left, pose.t_right)
        if self._render is render:
            left, right = render_together(
                [self.scene] * 2, torch.stack(rotations), torch.stack(centres), self.image_camera, self.source_px
            )
        else:
            left, right = (
                self._render(self.scene, r, t, self.image_camera, self.source_px)
                for r, t in zip(rotations, centres, strict=True)
            )
        for frame in (left, right):
            require(isinstance(frame, Frame), "renderer", type(frame).__name__, "a torchfovea.sim.rays.Frame")
            shape = (3, self.source_px, self.source_px)
            require(tuple(frame.image.shape) == shape, "renderer's image", tuple(frame.image.shape), str(shape))
        return self._exposed(left, right)

    def _exposed(self, left: Frame, right: Frame) -> tuple[Frame, Frame]:
        if self.noise is None:
            return left, right
        left, right = (
            frame._replace(image=expose(frame.image, self.noise, gain, self._chance))
            for frame, gain in zip((left, right), self._gains, strict=True)
        )
        return left, right

    def fixated(self, gaze: Gaze | None = None) -> Fixated:
        """The truth about a gaze (the current one by default): the first surface on the cyclopean ray."""
        rotation, origin = cyclopean(self.head, self._one(gaze))
        axis = rotation[:, 2]
        hits = cast(self.scene, origin, axis[None])
        point = origin + hits.range_m[0] * axis
        geom = hits.geom
        return Fixated(
            point,
            float(point.norm()),
            int(geom[0]),
            bool(self.scene.is_floor(geom)[0]),
            bool(self.scene.is_target(geom)[0]),
        )

    def panorama(self, directions_e: Tensor) -> RayHits:
        """The truth about directions (N, 3) from E's origin."""
        return cast(self.scene, torch.zeros(3, dtype=torch.float64), directions_e)

    def correspond(self, gaze: Gaze | None, left_directions: Tensor) -> Seen:
        """What the left eye's rays meet, and whether the right eye sees the same points: a sensor without pictures.

        Args:
            gaze: where the head looks; None for the current one.
            left_directions: (N, 3) in the left camera's frame, of any positive length.

        Returns:
            In the directions' dtype; computed in float64.
        """
        pose = eyes(self.head, self._one(gaze))
        direction = to_ego(pose.R_left, torch.nn.functional.normalize(left_directions.double(), dim=-1))
        hits = cast(self.scene, pose.t_left, direction)
        point = pose.t_left + hits.range_m[:, None] * direction
        line = point - pose.t_right
        away = line.norm(dim=-1)
        back = cast(self.scene, pose.t_right, line)
        hit = hits.geom >= 0
        # the right eye's own first hit is the point itself, but for rounding at grazing incidence
        free = back.range_m >= away - (1e-5 + 1e-5 * away)
        ahead = (line * pose.R_right[:, 2]).sum(-1) > 0
        return Seen(point.to(left_directions.dtype), hit, hit & free & ahead)

    def _one(self, gaze: Gaze | None) -> Gaze:
        if gaze is None:
            return self.gaze
        values = [torch.as_tensor(a).detach().to("cpu", torch.float64) for a in gaze]
        for name, value in zip(Gaze._fields, values, strict=True):
            require(
                value.numel() == 1 and bool(torch.isfinite(value).all()), f"gaze.{name}", value.tolist(), "one angle"
            )
        return Gaze(*(v.reshape(()) for v in values))


def images_together(worlds: Sequence[World], gazes: Sequence[Gaze]) -> list[tuple[Frame, Frame]]:
    """`World.images` of many worlds at a gaze each; small pictures of one kind cost half as much as one by one."""
    first = worlds[0]
    alike = all(world._render is render and world.source_px == first.source_px for world in worlds)
    most = _TOGETHER_PX // (2 * first.source_px**2)
    if most < 2 or not alike or any(world.image_camera != first.image_camera for world in worlds):
        return [world.images(gaze) for world, gaze in zip(worlds, gazes, strict=True)]
    found = []
    for start in range(0, len(worlds), most):
        part = worlds[start : start + most]
        poses = [
            eyes(world.head, world._one(gaze)) for world, gaze in zip(part, gazes[start : start + most], strict=True)
        ]
        rotation, centre = (torch.stack([eye for pose in poses for eye in (pose[k], pose[k + 2])]) for k in (0, 1))
        scenes = [world.scene for world in part for _ in range(2)]
        frames = render_together(scenes, rotation, centre, first.image_camera, first.source_px)
        found += [w._exposed(*pair) for w, *pair in zip(part, frames[::2], frames[1::2], strict=True)]
    return found
