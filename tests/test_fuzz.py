"""Every function of the front door on tensors of any shape, type, stride, size and scale: it keeps its promise, or says
in one line which argument it does not take. `scripts/fuzz.sh` runs many more examples than the suite does.

A promise is: no NaN from finite numbers of an ordinary size, whatever else happens no error but a `SettingError`, no
warning (they are errors here), and whole batches of nothing stay nothing.
"""

import math
import os
import random
from functools import cache

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

import torchfovea as tf
from torchfovea import metrics
from torchfovea.deciding import reward
from torchfovea.setting import SettingError

EXAMPLES = int(os.environ.get("FUZZ_EXAMPLES", "15"))
DTYPES = (torch.float32, torch.float32, torch.float64, torch.float64, torch.float16, torch.bfloat16, torch.int64)
SCALES = (1.0, 1.0, 1.0, 1.0, 1e-3, 1e3, 1e-30, 1e30)
SPECIAL = (math.nan, math.inf, -math.inf, 0.0, -1.0)
BATCHES = ((), (), (3,), (2, 3), (0,), (1,))
CAMERAS = (
    tf.Pinhole.from_fov(90.0, 20.0),
    tf.Fisheye.from_fov(160.0, 20.0),
    tf.BrownConrady(20.0, 21.0, 0.5, -0.5, (-0.1, 0.02, 1e-3, -1e-3)),
    tf.KannalaBrandt(20.0, 21.0, 0.5, -0.5, (0.01, -0.002, 0.0, 0.0)),
)
RETINAS = tf.LogPolar(200, 20.0), tf.Uniform(100, 20.0)
OBSERVER = tf.Observer(tf.Head(), CAMERAS[0], RETINAS[0])
CELLS = tf.sample(tf.direction_mixture([1.0], [[0.0, 0.0, 0.0]], [[1.0, 1.0, 1.0]]), 40, 0)


class Numbers:
    """Draws tensors by `draw`, which picks one of many; remembers whether they are finite, of an ordinary size and a
    usual type."""

    def __init__(self, draw):
        self.draw = draw
        self.dtype, self.batch, self.wild = draw(DTYPES), draw(BATCHES), draw(range(4)) == 0
        self.ordinary = self.dtype in (torch.float32, torch.float64)
        self.generator = torch.Generator().manual_seed(draw(range(2**32)))

    def pick(self, *choices):
        return self.draw(choices)

    def tensor(self, *shape, scale=None, middle=0.0):
        """(*batch, *shape) around a middle; now and then of another scale, with what is no number, or strided."""
        scale = self.pick(*SCALES) if scale is None else scale
        shape = (*self.batch, *shape)
        values = middle + scale * torch.randn(shape, generator=self.generator, dtype=torch.float64)
        self.ordinary &= 1e-4 < scale < 1e4
        if self.wild and values.numel():
            where = torch.rand(shape, generator=self.generator) < 0.3
            values[where] = self.pick(*SPECIAL)
            self.ordinary &= bool(torch.isfinite(values).all())
        values = values.clamp(-1e18, 1e18).to(self.dtype) if self.dtype == torch.int64 else values.to(self.dtype)
        match self.pick("plain", "plain", "reversed", "apart"):
            case "reversed" if values.dim() > 1:
                return values.mT.contiguous().mT
            case "apart" if values.dim():
                return torch.stack([values, values], -1)[..., 0]
        return values

    def positive(self, *shape):
        return self.tensor(*shape).abs() + 1e-3

    def cells(self, count):
        """Directions, of unit length or not."""
        directions = self.tensor(count, 3)
        unit = self.pick(True, True, False) and directions.is_floating_point()
        return torch.nn.functional.normalize(directions, dim=-1) if unit else directions

    def mask(self, *shape):
        return torch.rand((*self.batch, *shape), generator=self.generator) < 0.7

    def gaze(self):
        return tf.Gaze(*(self.tensor(scale=self.pick(0.1, 0.1, 1e3)) for _ in range(3)))

    def eyes(self):
        return tf.eyes(tf.Head(), self.gaze())

    def matches(self, n):
        left = self.tensor(n, 2, scale=self.pick(10.0, 10.0, 1e4))
        sigma = self.positive(n)
        return tf.Correspondences(
            left, left - self.positive(n)[..., None] * left.new_tensor([1, 0]), sigma, sigma, self.mask(n)
        )


@cache
def memory():
    """After a look of fifty matches."""
    generator = torch.Generator().manual_seed(1)
    left, gap = 10 * torch.randn(50, 2, generator=generator), torch.rand(50, generator=generator)
    sigma = torch.full((50,), 0.2)
    matches = tf.Correspondences(left, left - torch.stack([gap, 0 * gap], -1), sigma, sigma, gap > 0.1)
    seen = tf.eyes(tf.Head(), tf.Gaze(*(torch.tensor(v) for v in (0.1, 0.2, 0.1))))
    return tf.perceive(OBSERVER, tf.new_memory(OBSERVER, CELLS), matches, seen)


def leaves(value):
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, tuple):
        for part in value:
            yield from leaves(part)


def fovea(numbers):
    retina, size = numbers.pick(*RETINAS), numbers.pick((9, 9), (1, 1), (3, 40), (0, 4))
    image = numbers.tensor(numbers.pick(1, 3, 0), *size)
    return tf.fovea(image, numbers.pick(None, numbers.tensor(2)), retina, numbers.pick(None, 0.5, 0.0, math.nan))


def reconstruct(numbers):
    retina = numbers.pick(*RETINAS)
    values = numbers.tensor(numbers.pick(1, 3), numbers.pick(retina.count, retina.count, 7))
    return tf.reconstruct(values, retina, numbers.pick(20, (3, 9), 0, -1))


def interpolate(numbers):
    retina = numbers.pick(*RETINAS)
    values = torch.rand(2, 1, retina.count, generator=numbers.generator).to(numbers.dtype)
    return tf.interpolate(values, retina, numbers.tensor(2, scale=numbers.pick(10.0, 10.0, 1e4)))


def remember(numbers):
    observed = tf.observe(numbers.matches(5), numbers.eyes(), CAMERAS[0], numbers.positive(5))
    return tf.remember(memory(), observed, tf.Fusion())


def mixture(numbers):
    count = numbers.pick(1, 2, 0)
    numbers.batch = ()
    return tf.direction_mixture(
        numbers.positive(count),
        numbers.tensor(count, 3),
        numbers.pick(numbers.positive(count, 3), numbers.tensor(count, 3, 3)),
    )


FUZZED = {
    "belief": lambda n: tf.belief(memory()),
    "cartesian_belief": lambda n: tf.cartesian_belief(memory()),
    "choose": lambda n: tf.choose(n.tensor(n.pick(5, 0, 1)), n.mask(5), n.pick(None, n.generator)),
    "cortical": lambda n: tf.cortical(n.tensor(n.pick(RETINAS[0].count, 7)), RETINAS[0]),
    "cyclopean": lambda n: tf.cyclopean(tf.Head(), n.gaze()),
    "decide": lambda n: tf.decide(OBSERVER, memory(), n.generator, n.pick(None, n.gaze()))[:2],
    "direction_mixture": mixture,
    "expected_improvement": lambda n: tf.expected_improvement(n.tensor(5), n.positive(5), n.tensor()),
    "eyes": lambda n: tf.eyes(tf.Head(), n.gaze()),
    "fixate": lambda n: tf.fixate(tf.Head(), n.tensor(n.pick(3, 3, 3, 2))),
    "forget": lambda n: tf.forget(memory(), n.pick(0.5, 1.0, 0.0, -1.0, math.nan)),
    "fovea": fovea,
    "interpolate": interpolate,
    "log_density": lambda n: tf.log_density(
        tf.direction_mixture([1.0], [[1.0, 0.0, 0.0]], [[0.1, 0.2, 0.3]], dtype=n.dtype), n.tensor(3, scale=1.0)
    ),
    "log_expected_improvement": lambda n: tf.log_expected_improvement(n.tensor(5), n.positive(5), n.tensor()),
    "motion": lambda n: tf.motion(torch.eye(3), n.tensor(3), n.pick(None, n.tensor(6, 6))),
    "move": lambda n: tf.move(memory(), tf.motion(torch.eye(3), torch.randn(3, generator=n.generator)), tf.Fusion()),
    "new_memory": lambda n: tf.new_memory(OBSERVER, n.pick(n.cells(n.pick(4, 0)), n.tensor(4, 2))),
    "observe": lambda n: tf.observe(
        n.matches(5), n.eyes(), n.pick(*CAMERAS), n.positive(5), chart=n.pick("inverse_range", "cartesian", "polar")
    ),
    "perceive": lambda n: tf.perceive(OBSERVER, memory(), n.matches(7), n.eyes()),
    "place_features": lambda n: tf.place_features(n.pick(*RETINAS), n.pick(3, 0, -1), dtype=n.pick(None, n.dtype)),
    "reconstruct": reconstruct,
    "remember": remember,
    "resample": lambda n: tf.resample(memory(), n.cells(6), tf.Fusion()),
    "sample": lambda n: tf.sample(
        tf.direction_mixture([1.0], [[1.0, 0.0, 0.0]], [[0.1, 0.2, 0.3]]), n.pick(4, 0, -1), n.pick(n.generator, 3, -1)
    ),
    "triangulate": lambda n: tf.triangulate(n.tensor(3), n.tensor(3), n.tensor(3), n.tensor(3)),
    "unscented_transform": lambda n: tf.unscented_transform(
        torch.tanh, n.tensor(3), n.tensor(3, 3), tf.SigmaPoints(n.pick(3, 3, 2))
    ),
    "upper_confidence_bound": lambda n: tf.upper_confidence_bound(
        n.tensor(5), n.positive(5), n.pick(1.0, 0.0, n.tensor())
    ),
    "wrap_around": lambda n: tf.wrap_around(n.tensor(3, 5), n.pick(0, 1, 4, -1), n.pick(0, 1, 5, 6, -1)),
    "camera": lambda n: (lambda c: (c.rays(n.tensor(4, 2)), c.project(n.tensor(4, 3))))(n.pick(*CAMERAS)),
    "metrics": lambda n: (
        metrics.gap(n.tensor(n.pick(4, 0)), n.tensor()), metrics.regret(n.tensor(4), n.tensor()),
        metrics.nees(n.tensor(4), n.positive(4)), metrics.gaussian_nll(n.tensor(4), n.positive(4)),
    ),
    "reward": lambda n: (
        reward.range_from_inverse_range(reward.RewardBelief(n.tensor(4), n.positive(4))),
        reward.inverse_range_from_range(reward.RewardBelief(n.tensor(4), n.positive(4))),
    ),
}  # fmt: skip
ELSEWHERE = {
    "compiled": "the same functions again: test_compiling",
    "load_memory": "damaged files: test_store",
    "save_memory": "test_store",
}


def test_every_function_of_the_front_door_is_fuzzed():
    functions = {name for name in tf.__all__ if callable(found := getattr(tf, name)) and not isinstance(found, type)}
    assert functions == (FUZZED.keys() | ELSEWHERE.keys()) - {"camera", "metrics", "reward"}


@pytest.mark.parametrize("name", FUZZED)
@settings(max_examples=EXAMPLES)
@given(data=st.data())
def test_a_promise_or_one_line(name, data):
    numbers = Numbers(lambda choices: data.draw(st.sampled_from(choices)))
    try:
        found = FUZZED[name](numbers)
    except SettingError as error:
        assert "expected" in str(error) and "\n" not in str(error)
        return
    if numbers.ordinary:
        for leaf in leaves(found):
            assert not leaf.is_floating_point() or not leaf.isnan().any(), leaf


@pytest.mark.parametrize("name", FUZZED)
def test_mixed_precision_changes_nothing(name):
    """What a user wraps around the whole loop for the sake of a network; the layer has its own test in test_layer."""

    def answer(seed):
        numbers = Numbers(random.Random(seed).choice)
        numbers.dtype, numbers.wild = numbers.pick(torch.float32, torch.float64), False
        return [*leaves(FUZZED[name](numbers))]

    whole = 0
    for seed in range(2 * EXAMPLES):
        try:
            found = answer(seed)
        except SettingError:
            continue
        with torch.autocast("cpu", torch.bfloat16):
            again = answer(seed)
        whole += 1
        for one, other in zip(found, again, strict=True):
            torch.testing.assert_close(other, one, rtol=0, atol=0, equal_nan=True)
    assert whole > 0
