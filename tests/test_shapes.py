"""The shapes and types that docstrings promise, said by jaxtyping and checked by beartype, in both precisions.

A function here repeats the promise of the library's own of that name; dimensions of one name must agree within a call.
"""

from typing import Any

import pytest
import torch
from beartype import beartype
from jaxtyping import Bool, Float, TypeCheckError, jaxtyped
from torch import Tensor

import torchfovea as tf
from torchfovea.deciding.reward import range_reward

promised = jaxtyped(typechecker=beartype)


@promised
def fovea(image: Float[Tensor, "b c h w"], retina: Any) -> Float[Tensor, "b c n"]:
    return tf.fovea(image, None, retina)


@promised
def reconstruct(
    values: Float[Tensor, "b c n"], retina: Any, size_px: int
) -> tuple[Float[Tensor, "b c {size_px} {size_px}"], Bool[Tensor, "{size_px} {size_px}"]]:
    return tf.reconstruct(values, retina, size_px)


@promised
def eyes(
    pan: Float[Tensor, "*b"], tilt: Float[Tensor, "*b"], vergence: Float[Tensor, "*b"]
) -> tuple[Float[Tensor, "*b 3 3"], Float[Tensor, "*b 3"], Float[Tensor, "*b 3 3"], Float[Tensor, "*b 3"]]:
    return tuple(tf.eyes(tf.Head(), tf.Gaze(pan, tilt, vergence)))


@promised
def fixate(point: Float[Tensor, "*b 3"]) -> tuple[Float[Tensor, "*b"], Bool[Tensor, "*b"]]:
    gaze, reachable = tf.fixate(tf.Head(), point)
    return gaze.vergence, reachable


@promised
def rays(camera: Any, px: Float[Tensor, "*b 2"]) -> Float[Tensor, "*b 3"]:
    return camera.rays(px)


@promised
def project(camera: Any, points: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b 2"]:
    return camera.project(points)


@promised
def observe(
    left_px: Float[Tensor, "*b n 2"], right_px: Float[Tensor, "*b n 2"], support_px: Float[Tensor, "n"], pose: Any
) -> tuple[Float[Tensor, "*b n 3"], Float[Tensor, "*b n 6"], Bool[Tensor, "*b n"]]:
    sigma = torch.full_like(left_px[..., 0], 0.3)
    matches = tf.Correspondences(left_px, right_px, sigma, sigma, torch.ones_like(sigma, dtype=torch.bool))
    seen = tf.observe(matches, pose, tf.Pinhole.from_fov(90.0, 100.0), support_px)
    return seen.mean, seen.cov, seen.valid


@promised
def unscented_transform(
    mean: Float[Tensor, "*b n"], root: Float[Tensor, "*b n n"]
) -> tuple[Float[Tensor, "*b n"], Float[Tensor, "*b packed"], Float[Tensor, "points *b n"]]:
    return tf.unscented_transform(torch.sin, mean, root, tf.SigmaPoints(mean.shape[-1]))


@promised
def upper_confidence_bound(
    mean: Float[Tensor, "*b n"], std: Float[Tensor, "*b n"], alpha: float
) -> Float[Tensor, "*b n"]:
    return tf.upper_confidence_bound(mean, std, alpha)


@promised
def expected_improvement(
    mean: Float[Tensor, "*b n"], std: Float[Tensor, "*b n"], incumbent: Float[Tensor, "*b"]
) -> Float[Tensor, "*b n"]:
    return tf.expected_improvement(mean, std, incumbent)


@promised
def reward(mean: Float[Tensor, "*b 3"], cov: Float[Tensor, "*b 6"]) -> tuple[Float[Tensor, "*b"], Float[Tensor, "*b"]]:
    return tuple(range_reward(tf.Gaussian(mean, cov)))


@promised
def told(memory: tf.Memory, cells: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 6"]]:
    return tuple(tf.cartesian_belief(memory))


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)], ids=str)
def test_batches_lead(dtype, generator, batch):
    def draw(*shape):
        return torch.rand((*batch, *shape), generator=generator, dtype=torch.float64).to(dtype)

    pan, tilt, vergence = draw() - 0.5, draw() - 0.3, draw() * 0.3 + 0.05
    pose = tf.Eyes(*eyes(pan, tilt, vergence))
    fixate(draw(3) + torch.tensor([1.0, 0, 0], dtype=dtype))
    camera = tf.Pinhole.from_fov(90.0, 100.0)
    left = 100 * draw(7, 2) - 50
    project(camera, rays(camera, left))
    mean, cov, valid = observe(left, left - 3 * draw(7, 2), torch.ones(7, dtype=dtype), pose)
    assert mean.dtype == cov.dtype == dtype and valid.dtype == torch.bool
    means, packed, images = unscented_transform(draw(3), torch.eye(3, dtype=dtype).expand(*batch, 3, 3))
    assert packed.shape[-1] == 6 and images.shape[0] == 7 and means.dtype == dtype
    upper_confidence_bound(draw(9), draw(9), 2.0)
    expected_improvement(draw(9), draw(9), draw())
    reward(draw(3), torch.tensor([1.0, 0, 0, 1, 0, 1], dtype=dtype).expand(*batch, 6))


@pytest.mark.parametrize("retina", [tf.LogPolar(500, 50.0), tf.Uniform(500, 50.0)], ids=["log_polar", "uniform"])
def test_images(dtype, generator, retina):
    image = torch.rand(2, 3, 101, 101, generator=generator, dtype=torch.float64).to(dtype)
    values = fovea(image, retina)
    assert values.shape[-1] == retina.count and values.dtype == dtype
    reconstruct(values, retina, 101)


def test_a_memory(dtype, generator):
    observer = tf.Observer(tf.Head(), tf.Pinhole.from_fov(90.0, 100.0), tf.LogPolar(500))
    cells = tf.sample(tf.direction_mixture([1.0], [[0.0, 0.0, 0.0]], [torch.eye(3).tolist()]), 50, generator).to(dtype)
    memory = tf.new_memory(observer, cells)
    mean, cov = told(memory, cells)
    assert mean.dtype == cov.dtype == dtype


def test_a_broken_promise_is_noticed():
    """Else the above would check nothing."""
    with pytest.raises(TypeCheckError):
        upper_confidence_bound(torch.zeros(3), torch.zeros(4), 1.0)
    with pytest.raises(TypeCheckError):
        fovea(torch.zeros(3, 8, 8), tf.Uniform(100))
