import torch

from torchfovea.head import fixate
from torchfovea.sim.scene import AttentionWorld, build_scene
from torchfovea.sim.world import World


def test_fixating_the_truth_meets_the_target():
    scene = build_scene(AttentionWorld(), 0)
    world = World(scene, source_px=64)
    gaze, reachable = fixate(scene.head, scene.nearest_point_e)
    assert reachable
    moved = world.saccade(gaze)
    assert torch.equal(moved.gaze.pan, gaze.pan)
    seen = world.fixated()
    assert seen.is_target and not seen.is_floor
    assert abs(seen.range_m - scene.nearest_range_m) < 1e-3
