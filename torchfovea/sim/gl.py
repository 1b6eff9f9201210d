"""The renderer ``gl``: pictures by OpenGL through MuJoCo, the ray renderer's textures baked onto the solids."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import weakref
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchfovea.sensing.camera import Camera, Pinhole
from torchfovea.setting import SettingError, require
from torchfovea.sim.backend import load_mujoco, loadable_gl
from torchfovea.sim.model import Scene
from torchfovea.sim.rays import MISS_RANGE_M, Frame, Renderer
from torchfovea.sim.room import CAN, FLOOR, FURNITURE, POLE, ROOM, TARGET, Solid, build_spec
from torchfovea.sim.texture import colour

__all__ = ["available_gl", "opengl", "render"]

_TEXELS = {FLOOR: 1400, ROOM: 512, FURNITURE: 192, POLE: 24, CAN: 128, TARGET: 128}  # a side of a cube map
_SLAB_M = 0.01  # half thickness of the floor here: planes take no cube map
# OpenGL's cube faces: which axis they face, and the axes and signs of their columns and rows
_FACES = (
    (0, 1, 2, -1, 1, -1),
    (0, -1, 2, 1, 1, -1),
    (1, 1, 0, 1, 2, 1),
    (1, -1, 0, 1, 2, -1),
    (2, 1, 0, 1, 1, -1),
    (2, -1, 0, -1, 1, -1),
)
_PROBE = """
import mujoco
from mujoco.{backend} import GLContext
context = GLContext(16, 16)
context.make_current()
mujoco.MjrContext(mujoco.MjSpec().compile(), mujoco.mjtFontScale.mjFONTSCALE_100)
"""


@lru_cache(maxsize=1)
def available_gl() -> str | None:
    """The GL backend that renders on this machine without a display: "egl", "osmesa", or None.

    Tried in another process, for a broken backend can take the process with it; asked once.
    """
    for backend in ("egl", "osmesa"):
        if not loadable_gl(backend):
            continue
        env = {**os.environ, "MUJOCO_GL": backend}
        env.pop("PYOPENGL_PLATFORM", None)
        try:
            done = subprocess.run(
                [sys.executable, "-c", _PROBE.format(backend=backend)], env=env, capture_output=True, timeout=120
            )
        except (OSError, subprocess.TimeoutExpired):
            continue
        if done.returncode == 0:
            return backend
    return None


def _texture(scene: Scene, geom: int, solid: Solid) -> np.ndarray:
    """The cube map (6 W, W, 3) uint8 of a solid: the colours that the ray renderer gives its surface."""
    side = _TEXELS[solid.kind]
    sheet = np.full((6, side, side, 3), 128, np.uint8)
    size = np.array(_half_size(solid))
    c, s = math.cos(solid.yaw_rad), math.sin(solid.yaw_rad)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    texel = (np.arange(side) + 0.5) / side * 2 - 1
    for face, (axis, sign, across, across_sign, down, down_sign) in enumerate(_FACES):
        if solid.kind in (FLOOR, ROOM) and not _faces_room(solid, axis, sign):
            continue
        place = np.empty((side, side, 3))
        place[..., axis] = sign
        place[..., across] = across_sign * texel[None, :]
        place[..., down] = down_sign * texel[:, None]
        normal = np.zeros_like(place)
        normal[..., axis] = sign
        if solid.shape == "sphere":
            place /= np.linalg.norm(place, axis=-1, keepdims=True)
            normal = place
        elif solid.shape == "cylinder":
            # a cube map is looked up by direction: where that leaves the cylinder may be its side or a lid
            radial, upright = np.hypot(place[..., 0], place[..., 1]), np.abs(place[..., 2])
            place /= np.maximum(radial, upright)[..., None]
            curved = (radial >= upright)[..., None]
            normal = np.where(curved, place * [1.0, 1.0, 0.0], np.sign(place) * [0.0, 0.0, 1.0])
        points = (place * size) @ turn.T + solid.position_m
        width = torch.full((side, side), 2 * max(size[across], size[down]) / side)
        rgb = colour(scene.paint, torch.full((side, side), geom), _parts(points), _parts(normal @ turn.T), width)
        sheet[face] = (255 * rgb).round().byte().permute(1, 2, 0).numpy()
    return sheet.reshape(6 * side, side, 3)


def _parts(vectors: np.ndarray) -> tuple[Tensor, Tensor, Tensor]:
    """Vectors (..., 3) by component, in single precision."""
    x, y, z = torch.from_numpy(vectors).float().movedim(-1, 0).contiguous()
    return x, y, z


def _half_size(solid: Solid) -> tuple[float, float, float]:
    size = solid.size_m
    if solid.shape == "sphere":
        return size[0], size[0], size[0]
    return (size[0], size[0], size[1]) if solid.shape == "cylinder" else (size[0], size[1], size[2])


def _faces_room(solid: Solid, axis: int, sign: int) -> bool:
    thin = int(np.argmin(solid.size_m))
    return axis == thin and sign * solid.position_m[thin] < 0


class _Painter:
    """A GL context with one scene's textures in it."""

    def __init__(self, scene: Scene) -> None:
        mujoco = load_mujoco()
        backend = available_gl()
        if backend is None:
            raise SettingError("renderer = gl: expected a machine with EGL or OSMesa (renderer=rays needs neither)")
        if backend == "egl":
            from mujoco.egl import GLContext
        else:
            from mujoco.osmesa import GLContext
        # the floor becomes a slab whose top is where the plane was
        solids = [
            replace(s, shape="box", position_m=(*s.position_m[:2], -_SLAB_M), size_m=(*s.size_m[:2], _SLAB_M))
            if s.shape == "plane"
            else s
            for s in scene.solids
        ]
        spec = build_spec(solids, scene.head)
        # light is in the texture already
        spec.visual.headlight.ambient = [1, 1, 1]
        spec.visual.headlight.diffuse = [0, 0, 0]
        spec.visual.quality.numslices = spec.visual.quality.numstacks = 64
        for geom, solid in enumerate(solids):
            sheet = _texture(scene, geom, solid)
            name = f"paint_{geom}"
            texture = spec.add_texture(
                name=name,
                type=mujoco.mjtTexture.mjTEXTURE_CUBE,
                width=sheet.shape[1],
                height=sheet.shape[0],
                nchannel=3,
            )
            texture.data = sheet.tobytes()
            material = spec.add_material(name=name, specular=0.0, shininess=0.0)
            material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
            target = spec.geom(solid.name)
            target.material, target.rgba = name, [1, 1, 1, 1]
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self.data)
        self.gl = GLContext(self.model.vis.global_.offwidth, self.model.vis.global_.offheight)
        self.gl.make_current()
        self.context = mujoco.MjrContext(self.model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self.context)
        self.context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        self.scene = mujoco.MjvScene(self.model, maxgeom=1000)
        self.camera = mujoco.MjvCamera()
        self.camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self.camera.fixedcamid = self.model.camera("view").id
        self.eye = self.model.body("view").mocapid[0]

    def draw(self, R: np.ndarray, t: np.ndarray, fovy_rad: float, size_px: int) -> tuple[np.ndarray, ...]:
        """RGB (H, W, 3) uint8, depth along the axis (H, W) and geom (H, W) for a camera in the world."""
        mujoco = load_mujoco()
        quaternion = np.empty(4)
        # MuJoCo's cameras look along −z with y up
        mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(R * [1.0, -1.0, -1.0]).reshape(-1))
        self.data.mocap_pos[self.eye], self.data.mocap_quat[self.eye] = t, quaternion
        self.model.cam_fovy[self.camera.fixedcamid] = math.degrees(fovy_rad)
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        self.gl.make_current()
        mujoco.mjv_updateScene(
            self.model, self.data, mujoco.MjvOption(), None, self.camera, mujoco.mjtCatBit.mjCAT_ALL, self.scene
        )
        rect = mujoco.MjrRect(0, 0, size_px, size_px)
        rgb = np.empty((size_px, size_px, 3), np.uint8)
        depth = np.empty((size_px, size_px), np.float32)
        mujoco.mjr_render(rect, self.scene, self.context)
        mujoco.mjr_readPixels(rgb, depth, rect, self.context)
        flags = self.scene.flags
        flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = 1
        code = np.empty((size_px, size_px, 3), np.uint8)
        mujoco.mjr_render(rect, self.scene, self.context)
        mujoco.mjr_readPixels(code, None, rect, self.context)
        flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = 0
        near, far = (getattr(self.model.vis.map, n) * self.model.stat.extent for n in ("znear", "zfar"))
        # reversed depth: 1 at the near plane, 0 at the far one
        metric = near * far / (near + depth.astype(np.float64) * (far - near))
        names = np.full(self.scene.ngeom + 1, -1)
        for g in self.scene.geoms[: self.scene.ngeom]:
            if g.segid >= 0 and g.objtype == mujoco.mjtObj.mjOBJ_GEOM:
                names[g.segid + 1] = g.objid
        label = code.astype(np.int64) @ np.array([1, 256, 65536])
        return rgb[::-1], metric[::-1], names[np.clip(label, 0, len(names) - 1)][::-1]


_painters: weakref.WeakKeyDictionary[Any, _Painter] = weakref.WeakKeyDictionary()


def opengl() -> Renderer:
    """`render`, on a machine that can.

    Raises:
        SettingError: no EGL or OSMesa.
    """
    expected = "a machine with EGL or OSMesa (renderer=rays needs neither)"
    require(available_gl() is not None, "renderer", "gl", expected)
    return render


def render(scene: Scene, R: Tensor, t: Tensor, camera: Camera, size_px: int) -> Frame:
    """A square picture by OpenGL; its arguments and frame are `torchfovea.sim.rays.render`'s.

    The first picture of a scene bakes its textures (seconds). One thread only.

    Raises:
        SettingError: no EGL or OSMesa, a camera that is not a centred pinhole, or a size that cannot be.
    """
    require(isinstance(camera, Pinhole), "renderer", "gl", "a pinhole camera (renderer=rays has a fisheye)")
    require(isinstance(size_px, int) and 2 <= size_px <= 2048, "size_px", size_px, "a whole number from 2 to 2048")
    centre = (size_px - 1) / 2
    centred = abs(camera.cx_px - centre) < 1e-6 and abs(camera.cy_px - centre) < 1e-6
    require(centred, "camera.cx_px", (camera.cx_px, camera.cy_px), f"the picture's centre, {centre}, for renderer=gl")
    require(R.shape == (3, 3), "R", tuple(R.shape), "(3, 3)")
    require(t.shape == (3,), "t", tuple(t.shape), "(3,)")
    painter = _painters.get(scene.model)
    if painter is None:
        painter = _painters[scene.model] = _Painter(scene)
    rotation, translation = scene.world_from_ego
    turn = rotation @ R.detach().to("cpu", torch.float64).numpy()
    origin = rotation @ t.detach().to("cpu", torch.float64).numpy() + translation
    # MuJoCo's pixel centres are at u + 1/2 with the axis at size/2: ours are integers with the axis at (size − 1)/2
    rgb, depth, geom = painter.draw(turn, origin, 2 * math.atan(size_px / 2 / camera.focal_px), size_px)
    index = torch.arange(size_px, dtype=torch.float64)
    v, u = torch.meshgrid(index, index, indexing="ij")
    stretch = camera.rays(torch.stack([u, v], -1)).norm(dim=-1)
    label = torch.from_numpy(geom.copy())
    range_m = torch.from_numpy(depth.copy()) * stretch
    return Frame(
        torch.from_numpy(rgb.copy()).permute(2, 0, 1).float() / 255,
        torch.where(label >= 0, range_m, torch.full_like(range_m, MISS_RANGE_M)).float(),
        label,
    )
