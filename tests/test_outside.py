"""The robot from outside, in an episode's picture."""

import math

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from torchfovea.commands.search.pictures import SPHERE_M, draw_outside, outline
from torchfovea.episode import Rules, run_episode
from torchfovea.memory.sphere import fibonacci_directions
from torchfovea.perception import Observer, new_memory
from torchfovea.sensing.camera import Pinhole
from torchfovea.sensing.head import Gaze, Head, eyes
from torchfovea.sensing.layout import LogPolar
from torchfovea.sim.arena import SimulatedArena
from torchfovea.sim.room import FURNITURE, Solid, can
from torchfovea.sim.scene import Cans, build_scene
from torchfovea.sim.world import World


def test_things_are_drawn_where_they_stand():
    turned = Solid("box", FURNITURE, "box", (1.0, 2.0, 0.5), (0.3, 0.1, 0.5), math.pi / 2)
    corners = outline(turned).reshape(-1, 3)
    np.testing.assert_allclose(corners.min(0), [0.9, 1.7, 0.0], atol=1e-12)
    np.testing.assert_allclose(corners.max(0), [1.1, 2.3, 1.0], atol=1e-12)
    sides = outline(can("can", 0.5, -0.4, 0.2, 0.05, 0.12, True))
    away = np.linalg.norm(sides[..., :2] - [0.5, -0.4], axis=-1)
    np.testing.assert_allclose(away, 0.05)
    assert sides[..., 2].min() == pytest.approx(0.2) and sides[..., 2].max() == pytest.approx(0.32)


def test_an_episode_is_seen_from_outside():
    """The cells stand around E, and both eyes' lines of sight end on the surface that was met."""
    scene = build_scene(Cans(cans=3), 1, Head())
    observer = Observer(camera=Pinhole.from_fov(90.0, 100.0), retina=LogPolar(400))
    cells = fibonacci_directions(300)
    memory = new_memory(observer, cells)
    arena = SimulatedArena(World(scene, camera=observer.camera), observer, None)
    episode = run_episode(observer, memory, arena, arena.truth(cells), torch.Generator().manual_seed(0), Rules(3))
    figure = Figure()
    draw_outside(figure, 111, episode, scene)
    (axes,) = figure.axes
    lines = [np.array(line.get_data_3d()).T for line in axes.lines if len(line.get_data_3d()[0]) == 2]
    met = (episode.direction[-1] * episode.range_m[-1]).numpy()
    pose = eyes(scene.head, Gaze(*(angle[-1] for angle in episode.gaze)))
    for (start, end), eye in zip(lines, (pose.t_left, pose.t_right), strict=True):
        np.testing.assert_allclose(start, eye.numpy(), atol=1e-6)
        np.testing.assert_allclose(end, met, atol=1e-6)
    drawn = np.concatenate([np.array(dots._offsets3d).T for dots in axes.collections if hasattr(dots, "_offsets3d")])
    assert len(drawn) == 300 and np.allclose(np.linalg.norm(drawn, axis=-1), SPHERE_M, atol=1e-5)
    figure.canvas.draw()
