"""One step of the observer: correspondences and a memory in, a new memory and the next fixation out. Pure."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import InitVar, dataclass, field
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfovea.deciding.acquisition import Generators, choose
from torchfovea.deciding.eligibility import Eligibility
from torchfovea.deciding.reward import (
    RewardBelief,
    inverse_range_from_range,
    of_class,
    range_from_inverse_range,
    range_reward,
    user_reward,
)
from torchfovea.deciding.strategies import Strategy, View, evaluate, upper_confidence_bound
from torchfovea.gaussian import Gaussian, columns
from torchfovea.memory.classes import Classes, class_moments, new_classes
from torchfovea.memory.egosphere import (
    Fusion,
    Memory,
    Prior,
    belief,
    cartesian_from_patches,
    check_chart,
    empty_memory,
    inverse_range_belief,
    reducible,
    trust,
)
from torchfovea.memory.encoders import encoder_covariance
from torchfovea.memory.update import Common, remember
from torchfovea.memory.voting import against, within_sight
from torchfovea.sensing.camera import Camera, Pinhole
from torchfovea.sensing.correspondence import Budget, Correspondences
from torchfovea.sensing.head import Eyes, Gaze, Head, Kinematics, can_fixate, cyclopean, fixate
from torchfovea.sensing.kinship import kinship
from torchfovea.sensing.layout import LogPolar, Retina
from torchfovea.sensing.triangulation import observe
from torchfovea.sensing.unscented import SigmaPoints
from torchfovea.setting import require

SAME_GAZE_DEG = 2.0  # looks nearer to each other than about this see the same pixels of the same surfaces

__all__ = ["Eligibility", "Observer", "Step", "check_owner", "decide", "gaze_at", "new_memory", "perceive", "reward_of"]


@dataclass(frozen=True)
class Observer:
    """Everything about the observer that does not change while it looks around.

    Attributes:
        head: kinematics and limits: a `Head`, or one of your own (`torchfovea.sensing.head.Kinematics`).
        camera: both eyes' camera, in retinal pixels.
        retina: both eyes' retina.
        budget: where a correspondence's standard deviation comes from.
        points: sigma points of the unscented transform; None: those that suit the chart.
        rotated: see `torchfovea.sensing.unscented.sigma_root`.
        fusion: how observations enter the memory.
        prior: of a cell not yet seen.
        reward: `inverse_range` or `range`: near is good, in either measure (Eq. 36); or any function of points
            (..., 3) in E that returns a number for each (`torchfovea.deciding.reward.user_reward`).
        eligibility: which cells may be fixated.
        classes: what classes of things there are, and which one is sought: a cell's reward is then that of its surface
            times its share of the class. None: whatever is near is good.

    How it chooses among them is no part of it: `decide` and `torchfovea.search.search` take a `strategy`.
    """

    head: Any = field(default_factory=Head)
    camera: Camera = field(default_factory=lambda: Pinhole.from_fov(135.0, 100.0))
    retina: Retina = field(default_factory=LogPolar)
    budget: Budget = field(default_factory=Budget)
    points: SigmaPoints | None = None
    rotated: bool = True
    fusion: Fusion = field(default_factory=Fusion)
    prior: Prior = field(default_factory=Prior)
    reward: str | Callable[[Tensor], Tensor] = "inverse_range"
    eligibility: Eligibility = field(default_factory=Eligibility)
    classes: Classes | None = None
    acquisition: InitVar[None] = None  # where strategies once were

    def __post_init__(self, acquisition: None) -> None:
        """Raise SettingError for an unknown reward, and for a strategy."""
        given = getattr(acquisition, "__name__", type(acquisition).__name__)
        require(acquisition is None, "Observer(acquisition)", given, "decide(..., strategy=) or search(..., strategy=)")
        require(isinstance(self.head, Head | Kinematics), "head", self.head, "a Head, or Kinematics")
        known = self.reward in ("inverse_range", "range") or callable(self.reward)
        require(known, "reward", self.reward, "inverse_range, range or a function of points (..., 3)")
        near = self.classes is None or self.reward == "inverse_range"
        expected = "inverse_range for the nearest of a class, which is worth more than nothing"
        require(near, "reward", self.reward, expected)


class Step(NamedTuple):
    """What one step leaves behind.

    Attributes:
        memory: with what the saccade brought.
        points: 3-D belief of every cell (..., Nx).
        reward: its reward (..., Nx).
        eligible: which cells may be fixated, bool (..., Nx).
        cell: the one chosen, (...) int64; −1 if none is eligible.
        gaze: the fixation that it asks for; straight ahead if none.
        state: the strategy's own, for the next decision.
    """

    memory: Memory
    points: Gaussian
    reward: RewardBelief
    eligible: Tensor
    cell: Tensor
    gaze: Gaze
    state: Any = None


def new_memory(observer: Observer, cells: Tensor) -> Memory:
    """An observer's empty memory over given cells, unit directions (Nx, 3), or of B memories (B, Nx, 3).

    Raises:
        SettingError: for no cells, or directions that are not unit vectors.
    """
    empty = empty_memory(cells, observer.prior, observer.fusion.chart)
    return empty if observer.classes is None else empty._replace(classes=new_classes(observer.classes, cells))


def check_owner(observer: Observer, memory: Memory) -> None:
    """Refuse another observer's memory, whose numbers would mean something else.

    Raises:
        SettingError: for a memory of another chart or prior than the observer's; it names both.
    """
    check_chart(memory, observer.fusion.chart, "fusion.chart")
    require(observer.prior == memory.prior, "prior", observer.prior, f"{memory.prior}, the prior of the memory")
    known = 0 if memory.classes is None else memory.classes.shape[-1]
    asked = 0 if observer.classes is None else observer.classes.count
    require(asked in (0, known), "classes", asked, f"{known}, the classes of the memory")


def perceive(
    observer: Observer, memory: Memory, matches: Correspondences, eyes: Eyes, common: Common | None = None
) -> Memory:
    """Enter one saccade's correspondences into the memory.

    Args:
        observer: the fixed parts.
        memory: before.
        matches: the saccade's correspondences (..., N).
        eyes: where the eyes were.
        common: what the receptive fields' errors share, see `torchfovea.memory.update.remember`; by default what the
            head's encoders get wrong.

    Differentiable in the correspondences. Leaving out those that are not valid changes nothing: what each stands for
    it carries itself.

    Raises:
        SettingError: for a memory of another chart or prior than the observer's.
    """
    check_owner(observer, memory)
    support = observer.retina.width_px(matches.left_px) / 2 if matches.support_px is None else matches.support_px
    observed = observe(
        matches, eyes, observer.camera, support, observer.points, observer.fusion.chart, observer.rotated
    )
    sigma = math.radians(observer.head.encoder_deg)
    if common is None and sigma > 0:
        common = partial(encoder_covariance, eyes=eyes, sigma_rad=(sigma,) * 3, chart=observer.fusion.chart)
    axis = eyes.R_left[..., 2]
    kin = kinship(observer.budget, observer.retina, matches)
    if kin is not None and memory.axis is not None:
        # what looks at one place from one gaze share is all that its fields share
        same = torch.exp(-(((axis - memory.axis).norm(dim=-1, keepdim=True) / math.radians(SAME_GAZE_DEG)).square()))
        kin = kin._replace(lasting=kin.lasting + (kin.shared - kin.lasting).clamp(min=0) * same)
    after = remember(memory, observed, observer.fusion, common, kin, matches.classes)
    if observer.fusion.votes:
        missed = within_sight(memory, after.looks == memory.looks, eyes, observer.camera, observer.retina)
        after = after._replace(votes=against(after.votes, missed))
    return after._replace(axis=axis)


def _rewards(observer: Observer, memory: Memory) -> tuple[Gaussian, RewardBelief, RewardBelief, Tensor]:
    """Points of the surfaces, their reward, that of an unseen one (a number, or one for each cell), and a variance.

    The variance is what `torchfovea.memory.egosphere.reducible` asks for.
    """
    prior, cartesian = memory.prior, memory.chart == "cartesian"
    if cartesian:
        points = belief(memory)
        rho, variance = None, points.cov[..., 5]
    else:
        rho, variance = inverse_range_belief(memory)
        points = cartesian_from_patches(rho, variance, memory)
    if not isinstance(observer.reward, str):
        # the prior's range is uncertain along the ray; in x, y, z it is so in every direction
        sigma = prior.std if cartesian else prior.std / prior.mean**2
        x, y, z = memory.cells.unbind(-1)
        zero, one = torch.zeros_like(x), torch.ones_like(x)
        shape = (one, zero, zero, one, zero, one) if cartesian else (x * x, x * y, x * z, y * y, y * z, z * z)
        unseen = Gaussian(_unseen_points(memory), columns(*(sigma**2 * part for part in shape)))
        return points, user_reward(observer.reward, points), user_reward(observer.reward, unseen), variance
    like = points.mean.dtype
    if rho is None:
        reward = range_reward(points)
        then = RewardBelief(*(torch.tensor(v, dtype=like) for v in (-prior.mean, prior.std)))
        if observer.reward == "inverse_range":
            reward, then = inverse_range_from_range(reward), inverse_range_from_range(then)
    else:
        reward = RewardBelief(rho, variance.sqrt())
        then = RewardBelief(*(torch.tensor(v, dtype=like) for v in (prior.mean, prior.std)))
        if observer.reward == "range":
            reward, then = range_from_inverse_range(reward), range_from_inverse_range(then)
    return points, reward, then, variance


def reward_of(observer: Observer, memory: Memory) -> tuple[Gaussian, RewardBelief, Tensor]:
    """Each cell's 3-D belief, its reward (Eq. 36-40), and the standard deviation that is worth exploring (..., Nx).

    A surface is worth its reward as far as it is believed, for the rest what an unseen cell is: mean and standard
    deviation are averaged with the prior's by `torchfovea.memory.egosphere.trust`, so that no doubtful surface wins a
    comparison of thousands. Of the prior's standard deviation looks that should have shown something, and did not,
    leave less and less. Unseen cells that no look has reached share the prior's reward exactly: ties are ties. What no
    look can change is not worth exploring, see `torchfovea.memory.egosphere.reducible`. Where a class is sought, all is
    worth that as far as it is of the class.
    """
    points, reward, unseen, variance = _rewards(observer, memory)
    sure, fruitless = trust(memory), memory.votes[..., 1]
    mean, std = (then.to(reward.mean) for then in unseen)
    std = std * (1 + fruitless).rsqrt()
    mean = torch.where(sure > 0, sure * reward.mean + (1 - sure) * mean, mean)
    whole, open_to_looks = (
        torch.where(sure > 0, sure * known + (1 - sure) * std, std)
        for known in (reward.std, reward.std * reducible(memory, variance).sqrt())
    )
    if observer.classes is None or memory.classes is None:
        return points, RewardBelief(mean, whole), open_to_looks
    share = class_moments(memory.classes, observer.classes.sought)
    worth = of_class(RewardBelief(mean, whole), *share)
    return points, worth, of_class(RewardBelief(mean, open_to_looks), *share).std


def _unseen_points(memory: Memory) -> Tensor:
    """Where each cell's point would be if it had not been seen, (..., Nx, 3) [m]."""
    prior = memory.prior.mean
    return memory.cells * (prior if memory.chart == "cartesian" else 1 / prior)


def decide(
    observer: Observer,
    memory: Memory,
    generator: Generators | None = None,
    gaze: Gaze | None = None,
    before: Step | None = None,
    strategy: Strategy = upper_confidence_bound,
) -> Step:
    """Choose the next fixation (Eq. 41-43).

    Args:
        observer: the fixed parts.
        memory: what is known, (...).
        generator: breaks exact ties, and draws lots for the strategies that do; one, or one for each row.
        gaze: where the head looks now, (...), for strategies that mind the way; straight ahead if not given.
        before: the decision before, for strategies that remember.
        strategy: scores the cells, see `torchfovea.deciding.strategies`.

    Raises:
        SettingError: for a memory of another chart or prior than the observer's.
    """
    check_owner(observer, memory)
    points, reward, open_to_looks = reward_of(observer, memory)
    seen = memory.looks > 0
    # the eyes meet where the surface is, or where an unseen one would be while it is more likely not there
    doubted = seen & (trust(memory) < 0.5)
    at, instead = points.mean.unbind(-1), _unseen_points(memory).unbind(-1)
    target = columns(*(torch.where(doubted, there, here) for there, here in zip(instead, at, strict=True)))
    (x, y, z), limits = at, observer.eligibility
    surely = z - limits.ground_sigmas * points.cov[..., 5].sqrt()
    ground = seen & (surely + observer.head.ego_height_m < limits.ground_z_m)
    far_enough = (x * x).addcmul_(y, y).addcmul_(z, z) > limits.nearest_m**2
    eligible = can_fixate(observer.head, target) & far_enough & ~ground
    floor = torch.full_like(reward.mean, -torch.inf)
    incumbent = torch.where(eligible & seen, reward.mean, floor).amax(-1)
    incumbent = torch.where(torch.isfinite(incumbent), incumbent, torch.where(eligible, reward.mean, floor).amax(-1))
    incumbent = torch.where(torch.isfinite(incumbent), incumbent, torch.zeros_like(incumbent))
    zero = torch.zeros_like(incumbent)
    view = View(
        reward.mean,
        open_to_looks,
        incumbent,
        eligible,
        memory.cells,
        cyclopean(observer.head, Gaze(zero, zero, zero) if gaze is None else gaze)[0][..., 2],
        torch.full_like(zero, -1, dtype=torch.int64) if before is None else before.cell,
        generator,
        None if before is None else before.state,
        memory,
    )
    score, state = evaluate(strategy, view)
    cell = choose(score, eligible, generator)
    place = cell.clamp(min=0)[..., None]
    chosen = columns(*(part.gather(-1, place) for part in target.unbind(-1)))
    gaze = gaze_at(fixate(observer.head, chosen)[0], cell.clamp(max=0))
    return Step(memory, points, reward, eligible, cell, gaze, state)


def gaze_at(gazes: Gaze, cell: Tensor) -> Gaze:
    """The gaze of one cell among those of all (..., Nx); straight ahead for cell −1."""
    chosen, ahead = cell.clamp(min=0)[..., None], (cell >= 0).to(gazes.pan.dtype)
    return Gaze(*(angle.gather(-1, chosen)[..., 0] * ahead for angle in gazes))
