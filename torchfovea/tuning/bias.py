"""The numbers that are tuned: a flat vector, and the mixture and weights that it stands for."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.deciding.weighted import Weighting
from torchfovea.memory.sphere import DirectionMixture, fix_gauge
from torchfovea.setting import check_types, require

__all__ = [
    "Bias", "Shape", "decode", "encode", "features", "fix_vector", "fov_of", "mixture_of", "nudged", "numbers_of",
    "with_weights",
]  # fmt: skip

_LOG_DIAGONAL = (-3.0, 1.0)
_LOG_ALPHA = (-4.0, 4.0)
# of one number of the vector; what of the weights can be tuned here
_UNIT = {"by_time": 1.0, "by_unseen": 1.0, "improvement": 1.0, "information": 1.0, "cost_per_deg": 0.01}
_MEAN = _MOST_WEIGHT = 4.0
_FOV_DEG = (40.0, 150.0)


@dataclass(frozen=True)
class Shape:
    """How the vector is read.

    Attributes:
        components: M ≥ 1.
        conditioned: whether the mixture depends on a task (B, K) by quadratic regression: each of its numbers is a
            polynomial of the task, with six coefficients for K = 2 and 15 for K = 4.
        tune_alpha: whether log α is the last number of the vector; else α is `alpha`.
        alpha: of a vector without it.
        fov_deg: where the sensor's field of view starts if log tan(fov/2) is a number of the vector, the last; None:
            it is not tuned.
        weights: of the acquisition's other terms.
        tuned: which of these are numbers of the vector, after log α, starting at `weights`.
        task_numbers: K, of the task.
    """

    components: int = 1
    conditioned: bool = False
    tune_alpha: bool = True
    alpha: float = 1.0
    fov_deg: float | None = None
    weights: Weighting = field(default_factory=Weighting)
    tuned: tuple[str, ...] = ()
    task_numbers: int = 2

    def __post_init__(self) -> None:
        """Raise SettingError for values out of range."""
        check_types(self)
        require(1 <= self.components <= 64, "components", self.components, "a whole number from 1 to 64")
        fine = self.fov_deg is None or _FOV_DEG[0] <= self.fov_deg <= _FOV_DEG[1]
        require(fine, "sensor.fov_deg", self.fov_deg, f"from {_FOV_DEG[0]:.0f} to {_FOV_DEG[1]:.0f} to be tuned")
        require(math.exp(-4) <= self.alpha <= math.exp(4), "acquisition.alpha", self.alpha, "between 0.0183 and 54.6")
        for name in self.tuned:
            known = name in _UNIT and self.tuned.count(name) == 1
            require(known, "tune_weights", name, "each once, any of " + ", ".join(_UNIT))
            value, most = getattr(self.weights, name), _MOST_WEIGHT * _UNIT[name]
            require(abs(value) <= most, f"acquisition.{name}", value, f"from {-most:g} to {most:g} to be tuned")
        alone = self.weights.numbers["doubt"] == 0
        require(alone, "acquisition.doubt", self.weights.doubt, "0 in tuning, whose scenes have no classes")

    @property
    def numbers(self) -> int:
        """Of one mixture: means, log diagonals and lower triangles, and for M ≥ 2 the logits."""
        return 9 * self.components + (self.components if self.components > 1 else 0)

    @property
    def body(self) -> int:
        """Numbers of all mixtures; α's comes next."""
        return self.numbers * self.monomials

    @property
    def monomials(self) -> int:
        """Coefficients of each number: of a quadratic polynomial of the task, or one."""
        k = self.task_numbers
        return 1 + k + k * (k + 1) // 2 if self.conditioned else 1

    @property
    def size(self) -> int:
        """Of the vector."""
        return self.body + int(self.tune_alpha) + len(self.tuned) + int(self.fov_deg is not None)

    @property
    def policy(self) -> slice:
        """Where the acquisition's numbers are: log α and the tuned weights."""
        return slice(self.body, self.body + int(self.tune_alpha) + len(self.tuned))

    def tail(self, alpha: float, fov_deg: float | None) -> Tensor:
        """The vector's last numbers, with the weights where they start."""
        first = [math.log(alpha)] if self.tune_alpha else []
        weights = [getattr(self.weights, name) / _UNIT[name] for name in self.tuned]
        fov = [] if fov_deg is None else [math.log(math.tan(math.radians(fov_deg) / 2))]
        return torch.tensor([*first, *weights, *fov], dtype=torch.float64)


class Bias(NamedTuple):
    """Mixtures, one for each scene or one for all (B = 1), and the acquisition.

    Attributes:
        logits: (B, M).
        means: (B, M, 3).
        cholesky: (B, M, 3, 3).
        weights: of the acquisition; those that the vector holds are scalar tensors, as alpha always is.
    """

    logits: Tensor
    means: Tensor
    cholesky: Tensor
    weights: Weighting


def features(task: Tensor) -> Tensor:
    """Monomials of a task up to second order, (B, K) to (B, 1 + K + K(K + 1)/2): 1, a, e, a², a e, e² for K = 2."""
    first, second = torch.triu_indices(task.shape[-1], task.shape[-1])
    return torch.cat((torch.ones_like(task[:, :1]), task, task[:, first] * task[:, second]), -1)


def decode(shape: Shape, vector: Tensor, task: Tensor) -> Bias:
    """What a vector stands for.

    Args:
        shape: how to read it.
        vector: (shape.size,).
        task: (B, K); only a conditioned shape looks at it.

    Returns:
        Mixtures with clamped log diagonals (−3 to 1), one for each scene if conditioned, else one. Differentiable.
    """
    body = vector[: shape.body]
    raw = features(task) @ body.reshape(shape.monomials, -1) if shape.conditioned else body[None]
    m = shape.components
    means = raw[:, : 3 * m].unflatten(1, (m, 3))
    diagonal = raw[:, 3 * m : 6 * m].unflatten(1, (m, 3)).clamp(*_LOG_DIAGONAL).exp()
    lower = raw[:, 6 * m : 9 * m].unflatten(1, (m, 3))
    logits = raw[:, 9 * m :].clamp(-6, 6) if m > 1 else torch.zeros_like(raw[:, :1])
    zero = torch.zeros_like(lower[..., 0])
    rows = (
        (diagonal[..., 0], zero, zero),
        (lower[..., 0], diagonal[..., 1], zero),
        (lower[..., 1], lower[..., 2], diagonal[..., 2]),
    )
    cholesky = torch.stack([torch.stack(row, -1) for row in rows], -2)
    log_alpha = vector[shape.body].clamp(*_LOG_ALPHA) if shape.tune_alpha else vector.new_tensor(math.log(shape.alpha))
    ours = vector[shape.policy][int(shape.tune_alpha) :].clamp(-_MOST_WEIGHT, _MOST_WEIGHT)
    tuned = {name: _UNIT[name] * value for name, value in zip(shape.tuned, ours, strict=True)}
    return Bias(logits, means, cholesky, replace(shape.weights, alpha=log_alpha.exp(), **tuned))


def nudged(shape: Shape, weights: Weighting, offset: Tensor) -> Weighting:
    """A policy's weights for K rows, each with its log α and tuned weights moved by an offset (K, P) in the vector."""
    columns = list(offset.unbind(-1))
    k, moved = len(offset), {}
    for name in ("alpha", *shape.tuned):
        now = getattr(weights, name)
        if name == "alpha":
            by = columns.pop(0).to(now).exp() if shape.tune_alpha else now.new_ones(k)
            moved[name] = now * by
        else:
            moved[name] = now + _UNIT[name] * columns.pop(0).to(now)
    return replace(weights, **moved)


def with_weights(shape: Shape, vector: Tensor, **weights: float) -> Tensor:
    """The same bias with other weights of the acquisition, as far as they are numbers of the vector."""
    vector = vector.clone()
    names = (("alpha",) if shape.tune_alpha else ()) + shape.tuned
    for place, name in enumerate(names):
        if name in weights:
            value = math.log(weights[name]) if name == "alpha" else weights[name] / _UNIT[name]
            vector[shape.body + place] = value
    return vector


def encode(shape: Shape, mixture: DirectionMixture, alpha: float) -> Tensor:
    """The vector of one mixture and α, of a gauge in which E|v|² = 1.

    A mixture of fewer components than the shape is repeated, with its means a little apart to break the symmetry.
    A conditioned shape starts from the mixture for every task.

    Raises:
        SettingError: for a mixture with more components than the shape, or an α without a logarithm within ±4.
    """
    given, m = len(mixture.means), shape.components
    require(given <= m, "components", m, f"at least the {given} of the start")
    require(alpha > 0 and abs(math.log(alpha)) <= 4, "acquisition.alpha", alpha, "between 0.0183 and 54.6 at the start")
    mixture = fix_gauge(DirectionMixture(*(t.double() for t in mixture)))
    which = torch.arange(m) % given
    noise = torch.Generator().manual_seed(0)
    apart = torch.randn(m, 3, generator=noise, dtype=torch.float64) * (0.3 if m > given else 0)
    means = mixture.means[which] + apart * (torch.arange(m) >= given)[:, None]
    body = numbers_of(DirectionMixture(mixture.logits[which], means, mixture.cholesky[which]))
    if shape.conditioned:
        body = torch.cat((body, torch.zeros((shape.monomials - 1) * len(body), dtype=torch.float64)))
    return torch.cat([body, shape.tail(alpha, shape.fov_deg)])


def numbers_of(mixture: DirectionMixture) -> Tensor:
    """A mixture as `Shape.numbers` numbers of a vector, in the mixture's own gauge."""
    factor = mixture.cholesky
    diagonal = factor.diagonal(dim1=-2, dim2=-1).log().clamp(*_LOG_DIAGONAL)
    lower = torch.stack((factor[:, 1, 0], factor[:, 2, 0], factor[:, 2, 1]), -1)
    parts = [mixture.means.flatten(), diagonal.flatten(), lower.flatten()]
    return torch.cat(parts if len(factor) == 1 else [*parts, mixture.logits])


def fov_of(shape: Shape, vector: Tensor) -> float:
    """The field of view [deg] that a vector of a shape with one stands for, 40 to 150."""
    fov = 2 * math.degrees(math.atan(math.exp(float(vector[-1].clamp(-10, 10)))))
    return min(max(fov, _FOV_DEG[0]), _FOV_DEG[1])


def fix_vector(shape: Shape, vector: Tensor) -> Tensor:
    """The same policy in a fixed gauge and within the limits; an optimizer calls it after each step.

    A conditioned vector has no gauge of its own for each task: it is only clamped.
    """
    vector = vector.clone()
    if shape.tune_alpha:
        vector[shape.body] = vector[shape.body].clamp(*_LOG_ALPHA)
    ours = slice(shape.policy.start + int(shape.tune_alpha), shape.policy.stop)
    vector[ours] = vector[ours].clamp(-_MOST_WEIGHT, _MOST_WEIGHT)
    tail = vector[shape.body :]
    if shape.fov_deg is not None:
        tail[-1] = shape.tail(1.0, fov_of(shape, vector))[-1]
    if shape.conditioned:
        return vector.clamp(-_MEAN, _MEAN)
    bias = decode(shape, vector, vector.new_zeros(1, shape.task_numbers))
    mixture = DirectionMixture(bias.logits[0], bias.means[0], bias.cholesky[0])
    return torch.cat((encode(shape, mixture, float(bias.weights.alpha)).to(vector)[: shape.body], tail))


def mixture_of(shape: Shape, vector: Tensor, task: Tensor | None = None) -> DirectionMixture:
    """The mixture of a vector, for one task (K,) if it is conditioned."""
    bias = decode(
        shape, vector, torch.zeros(1, shape.task_numbers).to(vector) if task is None else task[None].to(vector)
    )
    return fix_gauge(DirectionMixture(bias.logits[0], bias.means[0], bias.cholesky[0]))
