"""One step of the observer: correspondences and a memory in, a new memory and the next fixation out. Pure."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfovea.deciding.acquisition import Generators, choose
from torchfovea.deciding.reward import (
    RewardBelief,
    inverse_range_from_range,
    range_from_inverse_range,
    range_reward,
    user_reward,
)
from torchfovea.deciding.strategies import DEFAULT, Strategy, View, evaluate
from torchfovea.gaussian import Gaussian, columns
from torchfovea.memory.egosphere import (
    EgoSphere,
    Fusion,
    Prior,
    belief,
    cartesian_belief,
    cartesian_from_patches,
    new_egosphere,
    trust,
)
from torchfovea.memory.encoders import encoder_covariance
from torchfovea.memory.nearest import CellIndex, build_index, neighbour_spacing_rad
from torchfovea.memory.update import Common, remember
from torchfovea.memory.voting import against
from torchfovea.sensing.camera import Camera, Pinhole
from torchfovea.sensing.correspondence import Budget, Correspondences, kinship
from torchfovea.sensing.head import Eyes, Gaze, Head, cyclopean, fixate, to_ego
from torchfovea.sensing.layout import LogPolar, Retina
from torchfovea.sensing.triangulation import observe
from torchfovea.sensing.unscented import SigmaPoints
from torchfovea.setting import require

SAME_GAZE_DEG = 2.0  # looks nearer to each other than about this see the same pixels of the same surfaces

__all__ = ["Eligibility", "Mind", "Observer", "Step", "decide", "gaze_at", "new_mind", "perceive", "reward_of"]


@dataclass(frozen=True)
class Eligibility:
    """Which cells may be fixated.

    Attributes:
        nearest_m: points nearer than this are not looked at.
        ground_z_m: a seen cell whose point lies lower than this above the floor is ground, and not an object.
    """

    nearest_m: float = 0.5
    ground_z_m: float = 0.05

    def __post_init__(self) -> None:
        """Raise SettingError for a negative distance, and numbers that are not finite."""
        require(0 <= self.nearest_m < math.inf, "eligibility.nearest_m", self.nearest_m, "at least 0 metres")
        require(math.isfinite(self.ground_z_m), "eligibility.ground_z_m", self.ground_z_m, "a finite height in metres")


@dataclass(frozen=True)
class Observer:
    """Everything about the observer that does not change while it looks around.

    Attributes:
        head: kinematics and limits.
        camera: both eyes' camera, in retinal pixels.
        retina: both eyes' retina.
        budget: where a correspondence's standard deviation comes from.
        points: sigma points of the unscented transform; None: those that suit the chart.
        rotated: see `torchfovea.sensing.unscented.sigma_root`.
        fusion: how observations enter the memory.
        prior: of a cell not yet seen.
        reward: `inverse_range` or `range`: near is good, in either measure (Eq. 36); or any function of points
            (..., 3) in E that returns a number for each (`torchfovea.deciding.reward.user_reward`).
        acquisition: scores the cells, see `torchfovea.deciding.strategies`.
        eligibility: which cells may be fixated.
    """

    head: Head = field(default_factory=Head)
    camera: Camera = field(default_factory=lambda: Pinhole.from_fov(135.0, 100.0))
    retina: Retina = field(default_factory=LogPolar)
    budget: Budget = field(default_factory=Budget)
    points: SigmaPoints | None = None
    rotated: bool = True
    fusion: Fusion = field(default_factory=Fusion)
    prior: Prior = field(default_factory=Prior)
    reward: str | Callable[[Tensor], Tensor] = "inverse_range"
    acquisition: Strategy = DEFAULT
    eligibility: Eligibility = field(default_factory=Eligibility)

    def __post_init__(self) -> None:
        """Raise SettingError for an unknown reward."""
        known = self.reward in ("inverse_range", "range") or callable(self.reward)
        require(known, "reward", self.reward, "inverse_range, range or a function of points (..., 3)")


class Mind(NamedTuple):
    """A memory with the index that finds its cells.

    Attributes:
        memory: the ego-sphere.
        lookup: finds the cell of a direction.
        spacing_rad: distance of each cell to its neighbours, (..., Nx).
        axis: where the left eye looked last, unit (..., 3) in E; None: there was no look.
    """

    memory: EgoSphere
    lookup: CellIndex
    spacing_rad: Tensor
    axis: Tensor | None = None


class Step(NamedTuple):
    """What one step leaves behind.

    Attributes:
        mind: with what the saccade brought.
        points: 3-D belief of every cell (..., Nx).
        reward: its reward (..., Nx).
        eligible: which cells may be fixated, bool (..., Nx).
        cell: the one chosen, (...) int64; −1 if none is eligible.
        gaze: the fixation that it asks for; straight ahead if none.
        state: the strategy's own, for the next decision.
    """

    mind: Mind
    points: Gaussian
    reward: RewardBelief
    eligible: Tensor
    cell: Tensor
    gaze: Gaze
    state: Any = None


def new_mind(observer: Observer, cells: Tensor) -> Mind:
    """An empty memory over given cells (..., Nx, 3), indexed."""
    memory = new_egosphere(cells, observer.prior, observer.fusion.chart)
    return Mind(memory, build_index(cells), neighbour_spacing_rad(cells))


def perceive(
    observer: Observer, mind: Mind, matches: Correspondences, eyes: Eyes, common: Common | None = None
) -> Mind:
    """Enter one saccade's correspondences into the memory.

    Args:
        observer: the fixed parts.
        mind: before.
        matches: the saccade's correspondences (..., N).
        eyes: where the eyes were.
        common: what the receptive fields' errors share, see `torchfovea.memory.egosphere.remember`; by default what the
            head's encoders get wrong.

    Differentiable in the correspondences. Where only some of the receptive fields were looked through, each stands for
    as many more as are missing and covers a wider patch.
    """
    share = observer.retina.count / max(1, matches.valid.shape[-1])
    support = observer.retina.width_px(matches.left_px) / 2 * math.sqrt(max(1.0, share))
    observed = observe(
        matches, eyes, observer.camera, support, observer.points, observer.fusion.chart, observer.rotated
    )
    sigma = math.radians(observer.head.encoder_deg)
    if common is None and sigma > 0:
        common = partial(encoder_covariance, eyes=eyes, sigma_rad=(sigma,) * 3, chart=observer.fusion.chart)
    axis = eyes.R_left[..., 2]
    kin = kinship(observer.budget, observer.retina, matches.left_px, 1 / share)
    if kin is not None and mind.axis is not None:
        # what looks at one place from one gaze share is all that its fields share
        same = torch.exp(-(((axis - mind.axis).norm(dim=-1, keepdim=True) / math.radians(SAME_GAZE_DEG)).square()))
        kin = kin._replace(lasting=kin.lasting + (kin.shared - kin.lasting) * same)
    before = mind.memory
    after = remember(before, mind.lookup, mind.spacing_rad, observed, observer.fusion, observer.prior, common, kin)
    if observer.fusion.votes:
        missed = (after.looks == before.looks) & _in_view(observer, before, eyes)
        after = after._replace(votes=against(after.votes, missed))
    return mind._replace(memory=after, axis=axis)


def _in_view(observer: Observer, memory: EgoSphere, eyes: Eyes) -> Tensor:
    """Which cells' points fall on both retinas, bool (..., Nx)."""
    with torch.no_grad():
        points = cartesian_belief(memory, observer.fusion.chart).mean
        inside = torch.ones_like(memory.looks, dtype=torch.bool)
        for rotation, origin in ((eyes.R_left, eyes.t_left), (eyes.R_right, eyes.t_right)):
            direction = to_ego(rotation.mT, points - origin.unsqueeze(-2))
            inside &= observer.camera.in_view(direction) & observer.retina.inside(observer.camera.project(direction))
    return inside


def _rewards(observer: Observer, mind: Mind) -> tuple[Gaussian, RewardBelief, RewardBelief]:
    """Points of the surfaces, their reward, and that of an unseen one: a number, or one for each cell."""
    moments, prior, cartesian = belief(mind.memory), observer.prior, observer.fusion.chart == "cartesian"
    points = moments if cartesian else cartesian_from_patches(moments, mind.memory)
    if not isinstance(observer.reward, str):
        # the prior's range is uncertain along the ray; in x, y, z it is so in every direction
        sigma = prior.std if cartesian else prior.std / prior.mean**2
        x, y, z = mind.memory.cells.unbind(-1)
        zero, one = torch.zeros_like(x), torch.ones_like(x)
        shape = (one, zero, zero, one, zero, one) if cartesian else (x * x, x * y, x * z, y * y, y * z, z * z)
        unseen = Gaussian(_unseen_points(observer, mind), columns(*(sigma**2 * part for part in shape)))
        return points, user_reward(observer.reward, points), user_reward(observer.reward, unseen)
    like = points.mean.dtype
    if cartesian:
        reward = range_reward(points)
        then = RewardBelief(*(torch.tensor(v, dtype=like) for v in (-prior.mean, prior.std)))
        if observer.reward == "inverse_range":
            reward, then = inverse_range_from_range(reward), inverse_range_from_range(then)
    else:
        reward = RewardBelief(moments.mean[..., 2], moments.cov[..., 5].sqrt())
        then = RewardBelief(*(torch.tensor(v, dtype=like) for v in (prior.mean, prior.std)))
        if observer.reward == "range":
            reward, then = range_from_inverse_range(reward), range_from_inverse_range(then)
    return points, reward, then


def reward_of(observer: Observer, mind: Mind) -> tuple[Gaussian, RewardBelief]:
    """Each cell's 3-D belief and reward (Eq. 36-40).

    A surface is worth its reward as far as it is believed, for the rest what an unseen cell is: mean and standard
    deviation are averaged with the prior's by `torchfovea.memory.egosphere.trust`, so that no doubtful surface wins a
    comparison of thousands. Of the prior's standard deviation looks that should have shown something, and did not,
    leave less and less. Unseen cells that no look has reached share the prior's reward exactly: ties are ties.
    """
    points, reward, unseen = _rewards(observer, mind)
    sure, fruitless = trust(mind.memory), mind.memory.votes[..., 1]
    mean, std = (then.to(reward.mean) for then in unseen)
    std = std * (1 + fruitless).rsqrt()
    mean = torch.where(sure > 0, sure * reward.mean + (1 - sure) * mean, mean)
    std = torch.where(sure > 0, sure * reward.std + (1 - sure) * std, std)
    return points, RewardBelief(mean, std)


def _unseen_points(observer: Observer, mind: Mind) -> Tensor:
    """Where each cell's point would be if it had not been seen, (..., Nx, 3) [m]."""
    prior = observer.prior.mean
    return mind.memory.cells * (prior if observer.fusion.chart == "cartesian" else 1 / prior)


def decide(
    observer: Observer,
    mind: Mind,
    generator: Generators | None = None,
    gaze: Gaze | None = None,
    before: Step | None = None,
) -> Step:
    """Choose the next fixation (Eq. 41-43).

    Args:
        observer: the fixed parts.
        mind: what is known, (...).
        generator: breaks exact ties, and draws lots for the strategies that do; one, or one for each row.
        gaze: where the head looks now, (...), for strategies that mind the way; straight ahead if not given.
        before: the decision before, for strategies that remember.
    """
    points, reward = reward_of(observer, mind)
    seen = mind.memory.looks > 0
    # the eyes meet where the surface is, or where an unseen one would be while it is more likely not there
    doubted = seen & (trust(mind.memory) < 0.5)
    target, reachable = fixate(
        observer.head, torch.where(doubted[..., None], _unseen_points(observer, mind), points.mean)
    )
    ground = seen & (points.mean[..., 2] + observer.head.ego_height_m < observer.eligibility.ground_z_m)
    far_enough = (points.mean * points.mean).sum(-1) > observer.eligibility.nearest_m**2
    eligible = reachable & far_enough & ~ground
    floor = torch.full_like(reward.mean, -torch.inf)
    incumbent = torch.where(eligible & seen, reward.mean, floor).amax(-1)
    incumbent = torch.where(torch.isfinite(incumbent), incumbent, torch.where(eligible, reward.mean, floor).amax(-1))
    incumbent = torch.where(torch.isfinite(incumbent), incumbent, torch.zeros_like(incumbent))
    zero = torch.zeros_like(incumbent)
    view = View(
        reward.mean,
        reward.std,
        incumbent,
        eligible,
        mind.memory.cells,
        cyclopean(observer.head, Gaze(zero, zero, zero) if gaze is None else gaze)[0][..., 2],
        torch.full_like(zero, -1, dtype=torch.int64) if before is None else before.cell,
        generator,
        None if before is None else before.state,
    )
    score, state = evaluate(observer.acquisition, view)
    cell = choose(score, eligible, generator)
    return Step(mind, points, reward, eligible, cell, gaze_at(target, cell), state)


def gaze_at(gazes: Gaze, cell: Tensor) -> Gaze:
    """The gaze of one cell among those of all (..., Nx); straight ahead for cell −1."""
    chosen, ahead = cell.clamp(min=0)[..., None], (cell >= 0).to(gazes.pan.dtype)
    return Gaze(*(angle.gather(-1, chosen)[..., 0] * ahead for angle in gazes))
