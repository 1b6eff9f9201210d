"""The numbers that are tuned: a flat vector, the mixture and α that it stands for, and cells drawn from it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.memory.sphere import DirectionMixture, Quadrature, deep_tail, fix_gauge, log_radial_moment
from torchfovea.sensing.head import Head, fixate
from torchfovea.setting import require

__all__ = [
    "Bias", "Shape", "decode", "draw_cells", "encode", "features", "fix_vector", "fov_of", "log_density_each",
    "log_normalizer_each", "mixture_of", "numbers_of", "reachable",
]  # fmt: skip

REACH_RANGE_M = 1.0  # as in `torchfovea.commands.shared.build`: a direction is reachable if its point at 1 m is
_LOG_DIAGONAL = (-3.0, 1.0)
_LOG_ALPHA = (-4.0, 4.0)
_MEAN = 4.0
_FOV_DEG = (40.0, 150.0)
_FEWEST_ACCEPTED = 1e-3


@dataclass(frozen=True)
class Shape:
    """How the vector is read.

    Attributes:
        components: M ≥ 1.
        conditioned: whether the mixture depends on a task (B, 2) by quadratic regression: each of its numbers is a
            polynomial of the task with six coefficients.
        tune_alpha: whether log α is the last number of the vector; else α is `alpha`.
        alpha: of a vector without it.
        fov_deg: where the sensor's field of view starts if log tan(fov/2) is a number of the vector, after log α; None:
            it is not tuned.
    """

    components: int = 1
    conditioned: bool = False
    tune_alpha: bool = True
    alpha: float = 1.0
    fov_deg: float | None = None

    def __post_init__(self) -> None:
        """Raise SettingError for values out of range."""
        good = isinstance(self.components, int) and 1 <= self.components <= 64
        require(good, "components", self.components, "a whole number from 1 to 64")
        fine = self.fov_deg is None or _FOV_DEG[0] <= self.fov_deg <= _FOV_DEG[1]
        require(fine, "sensor.fov_deg", self.fov_deg, f"from {_FOV_DEG[0]:.0f} to {_FOV_DEG[1]:.0f} to be tuned")
        require(math.exp(-4) <= self.alpha <= math.exp(4), "acquisition.alpha", self.alpha, "between 0.0183 and 54.6")

    @property
    def numbers(self) -> int:
        """Of one mixture: means, log diagonals and lower triangles, and for M ≥ 2 the logits."""
        return 9 * self.components + (self.components if self.components > 1 else 0)

    @property
    def body(self) -> int:
        """Numbers of all mixtures; α's comes next."""
        return self.numbers * (6 if self.conditioned else 1)

    @property
    def size(self) -> int:
        """Of the vector."""
        return self.body + int(self.tune_alpha) + int(self.fov_deg is not None)

    def tail(self, alpha: float, fov_deg: float | None) -> Tensor:
        """The vector's last numbers."""
        fov = [] if fov_deg is None else [math.log(math.tan(math.radians(fov_deg) / 2))]
        return torch.tensor(([math.log(alpha)] if self.tune_alpha else []) + fov, dtype=torch.float64)


class Bias(NamedTuple):
    """Mixtures, one for each scene or one for all (B = 1), and the exploration weight.

    Attributes:
        logits: (B, M).
        means: (B, M, 3).
        cholesky: (B, M, 3, 3).
        alpha: scalar.
    """

    logits: Tensor
    means: Tensor
    cholesky: Tensor
    alpha: Tensor


def features(task: Tensor) -> Tensor:
    """Monomials of a task up to second order, (B, 2) to (B, 6)."""
    a, e = task.unbind(-1)
    return torch.stack((torch.ones_like(a), a, e, a * a, a * e, e * e), -1)


def decode(shape: Shape, vector: Tensor, task: Tensor) -> Bias:
    """What a vector stands for.

    Args:
        shape: how to read it.
        vector: (shape.size,).
        task: (B, 2); only a conditioned shape looks at it.

    Returns:
        Mixtures with clamped log diagonals (−3 to 1), one for each scene if conditioned, else one. Differentiable.
    """
    body = vector[: shape.body]
    raw = features(task) @ body.reshape(6, -1) if shape.conditioned else body[None]
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
    return Bias(logits, means, cholesky, log_alpha.exp())


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
        body = torch.cat((body, torch.zeros(5 * len(body), dtype=torch.float64)))
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
    tail = vector[shape.body :]
    if shape.fov_deg is not None:
        tail[-1] = shape.tail(1.0, fov_of(shape, vector))[-1]
    if shape.conditioned:
        return vector.clamp(-_MEAN, _MEAN)
    bias = decode(shape, vector, vector.new_zeros(1, 2))
    mixture = DirectionMixture(bias.logits[0], bias.means[0], bias.cholesky[0])
    return torch.cat((encode(shape, mixture, float(bias.alpha)).to(vector)[: shape.body], tail))


def mixture_of(shape: Shape, vector: Tensor, task: Tensor | None = None) -> DirectionMixture:
    """The mixture of a vector, for one task (2,) if it is conditioned."""
    bias = decode(shape, vector, torch.zeros(1, 2).to(vector) if task is None else task[None].to(vector))
    return fix_gauge(DirectionMixture(bias.logits[0], bias.means[0], bias.cholesky[0]))


def reachable(head: Head, directions: Tensor) -> Tensor:
    """Whether the head can fixate points at 1 m in these directions, (..., 3) to bool (...)."""
    return fixate(head, REACH_RANGE_M * directions)[1]


def draw_cells(
    bias: Bias, scenes: int, cells: int, head: Head, generator: torch.Generator, strict: bool = True
) -> Tensor:
    """Draw every scene's cells within reach (B, N, 3), slot by slot.

    Every slot has its own sequence of random numbers and takes its first reachable draw, so that a slightly different
    bias gives slightly different cells.

    Args:
        bias: B mixtures, or one for all.
        scenes: B.
        cells: N.
        head: whose reach.
        generator: random state.
        strict: whether cells without a reachable draw are an error; else they are zero vectors.

    Raises:
        SettingError: where hardly any draw is reachable.
    """
    dtype, m = bias.means.dtype, bias.means.shape[1]
    logits, means, factor = (t.detach().expand(scenes, *t.shape[1:]) for t in (bias.logits, bias.means, bias.cholesky))
    edges = logits.softmax(-1).cumsum(-1)
    direction = torch.zeros(scenes, cells, 3, dtype=dtype)
    waiting, tried, block = torch.arange(scenes * cells), 0, 4
    seed = torch.randint(2**62, (), generator=generator)
    while len(waiting):
        counter = waiting * 2**20 + torch.arange(tried, tried + block)[:, None]
        draws = torch.stack((*_normal(seed + 2, counter, dtype), _normal(seed + 3, counter, dtype)[0]), -1)
        if len(bias.means) == m == 1:
            v = means[0, 0] + draws @ factor[0, 0].mT
        else:
            scene = (waiting // cells).expand_as(counter)
            lot = _uniform(seed + 1, counter, dtype)[0]
            component = (lot[..., None] > edges[scene]).sum(-1).clamp(max=m - 1)
            v = means[scene, component] + (factor[scene, component] @ draws[..., None])[..., 0]
        unit = torch.nn.functional.normalize(v, dim=-1)
        good = reachable(head, unit)
        tried, block = tried + block, min(2 * block, 64)
        order = torch.arange(len(good))[:, None]
        first = torch.where(good, order, len(good)).amin(0)
        any_good = first < len(good)
        direction.view(-1, 3)[waiting[any_good]] = unit[first[any_good], any_good.nonzero()[:, 0]]
        waiting = waiting[~any_good]
        filled = 1 - len(waiting) / (scenes * cells)
        # a share s of reachable draws would have filled 1 − (1 − s)^tried by now
        enough = tried < 512 or filled > 1 - (1 - _FEWEST_ACCEPTED) ** tried
        enough = enough and tried < 16 / _FEWEST_ACCEPTED
        if not (strict or enough):
            break
        require(
            enough,
            "reachable",
            f"{filled:.1%} of the cells after {tried} draws each",
            "at least one draw in a thousand within the head's reach: the bias and the reachable set do not overlap",
        )
    return direction


def _uniform(seed: Tensor, counter: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Two uniform numbers in (0, 1] for each counter: SplitMix64 (Steele, Lea, Flood 2014), any of them at any time."""
    x = (seed * 0x632BE59BD9B4E019 + counter) * -0x61C8864680B583EB
    x = (x ^ (x >> 30 & 0x3FFFFFFFF)) * -0x40A7B892E31B1A47
    x = (x ^ (x >> 27 & 0x1FFFFFFFFF)) * -0x6B2FB644ECCEEE15
    x = x ^ (x >> 31 & 0x1FFFFFFFF)
    return ((x & 0xFFFFFFFF).to(dtype) + 0.5) / 2**32, ((x >> 32 & 0xFFFFFFFF).to(dtype) + 0.5) / 2**32


def _normal(seed: Tensor, counter: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Two standard normal numbers for each counter (Box and Muller 1958)."""
    u, v = _uniform(seed, counter, dtype)
    radius, angle = (-2 * u.log()).sqrt(), 2 * math.pi * v
    return radius * angle.cos(), radius * angle.sin()


def log_density_each(bias: Bias, directions: Tensor) -> Tensor:
    """`torchfovea.memory.sphere.log_density` of a batch of mixtures, each at its own directions.

    Args:
        bias: B mixtures (or one for all).
        directions: unit (B, K, 3).

    Returns:
        (B, K), per steradian. Differentiable in the mixtures.
    """
    u = directions.unsqueeze(-2)
    eye = torch.eye(3, dtype=u.dtype, device=u.device)
    whitening = torch.linalg.solve_triangular(bias.cholesky, eye.expand_as(bias.cholesky), upper=False)
    w = torch.einsum("bmij,bkj->bkmi", whitening.expand(len(directions), -1, -1, -1), directions)
    y = (whitening @ bias.means[..., None])[..., 0][:, None]
    length = w.square().sum(-1).sqrt()
    w = w / length[..., None]
    d = (w * y).sum(-1)
    off_axis = torch.linalg.cross(w, y.expand_as(w)).square().sum(-1)
    radial = log_radial_moment(d) - 0.5 * torch.where(d > -deep_tail(d.dtype)[0], off_axis, y.square().sum(-1))
    log_det = bias.cholesky.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    weight = (bias.logits.log_softmax(-1) - math.log(2 * math.pi) - log_det)[:, None]
    return torch.logsumexp(weight - 3 * length.log() + radial, -1)


def log_normalizer_each(bias: Bias, quadrature: Quadrature) -> Tensor:
    """Log probability of the reachable set under each mixture, (B,). Differentiable."""
    directions = quadrature.directions.to(bias.means).expand(len(bias.means), -1, -1)
    return torch.logsumexp(log_density_each(bias, directions) + quadrature.solid_angle_sr.to(bias.means).log(), -1)
