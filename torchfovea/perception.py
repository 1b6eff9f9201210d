"""One step of the observer: correspondences and a memory in, a new memory and the next fixation out. Pure."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import InitVar, dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchfovea.compiling import check_mode, compiling
from torchfovea.deciding.acquisition import Generators, choose
from torchfovea.deciding.eligibility import Eligibility
from torchfovea.deciding.reward import RewardBelief
from torchfovea.deciding.strategies import Strategy, View, evaluate, upper_confidence_bound
from torchfovea.deciding.worth import appraise
from torchfovea.gaussian import Gaussian, columns
from torchfovea.memory.classes import Classes, new_classes
from torchfovea.memory.egosphere import Fusion, Memory, Prior, check_chart, empty_memory
from torchfovea.memory.encoders import encoder_covariance
from torchfovea.memory.update import Common, remember
from torchfovea.memory.voting import against, within_sight
from torchfovea.rounding import unrounded
from torchfovea.sensing.camera import Camera, Pinhole
from torchfovea.sensing.correspondence import Budget, Correspondences
from torchfovea.sensing.head import Eyes, Gaze, Head, Kinematics, cyclopean, fixate
from torchfovea.sensing.kinship import kinship
from torchfovea.sensing.layout import LogPolar, Retina
from torchfovea.sensing.triangulation import Observations, observe
from torchfovea.sensing.unscented import SigmaPoints
from torchfovea.setting import check_types, require

SAME_GAZE_DEG = 2.0  # looks nearer to each other than about this see the same pixels of the same surfaces

__all__ = [
    "Eligibility",
    "Observer",
    "Step",
    "check_owner",
    "compiled",
    "decide",
    "gaze_at",
    "new_memory",
    "observed",
    "perceive",
]


@dataclass(frozen=True)
class Observer:
    """Everything about the observer that does not change while it looks around.

    Attributes:
        head: kinematics and limits: a `Head`, or one of your own (`torchfovea.sensing.head.Kinematics`).
        camera: both eyes' camera, or the left one's, in retinal pixels.
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
        camera_right: the right eye's camera, if it is another; simulated eyes are alike.
        compile: whether what is hot runs as compiled kernels, see `compiled`: off, auto or on.

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
    camera_right: Camera | None = None
    compile: str = "off"
    acquisition: InitVar[None] = None  # where strategies once were

    @property
    def cameras(self) -> tuple[Camera, Camera]:
        """The left eye's and the right eye's."""
        return self.camera, self.camera if self.camera_right is None else self.camera_right

    def __post_init__(self, acquisition: None) -> None:
        """Raise SettingError for an unknown reward, and for a strategy."""
        given = getattr(acquisition, "__name__", type(acquisition).__name__)
        require(acquisition is None, "Observer(acquisition)", given, "decide(..., strategy=) or search(..., strategy=)")
        check_types(self)
        require(isinstance(self.head, Head | Kinematics), "head", self.head, "a Head, or Kinematics")
        for name, camera in zip(("camera", "camera_right"), self.cameras, strict=True):
            require(isinstance(camera, Camera), name, camera, "a camera: Pinhole, Fisheye, BrownConrady, KannalaBrandt")
        require(
            isinstance(self.retina, Retina), "retina", self.retina, "a layout: LogPolar, Uniform or one of your own"
        )
        for name, kind in (("points", SigmaPoints), ("classes", Classes)):
            own = getattr(self, name)
            require(own is None or isinstance(own, kind), name, own, f"{kind.__name__}, or None")
        check_mode(self.compile)
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


def compiled(observer: Observer, mode: str = "auto") -> Observer:
    """The same observer, whose `perceive` and `decide` run as compiled kernels, with equal results to rounding.

    On the CPU those are loops in C, which take some seconds to build the first time on a machine
    (`torchfovea.machine`); what no loop does runs as written. On a GPU PyTorch's compiler makes them, which takes half
    a minute (`torchfovea.compiling`).

    Args:
        observer: any; what its settings leave uncompiled runs as written.
        mode: `auto`, which falls back with one line where nothing can be compiled; `on`, which raises; or `off`.

    Raises:
        SettingError: for another mode.
    """
    return replace(observer, compile=mode)


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
    for name, given, kind in (("observer", observer, Observer), ("memory", memory, Memory)):
        require(isinstance(given, kind), name, type(given).__name__, f"a torchfovea.{kind.__name__}")
    check_chart(memory, observer.fusion.chart, "fusion.chart")
    require(observer.prior == memory.prior, "prior", observer.prior, f"{memory.prior}, the prior of the memory")
    known = 0 if memory.classes is None else memory.classes.shape[-1]
    asked = 0 if observer.classes is None else observer.classes.count
    require(asked in (0, known), "classes", asked, f"{known}, the classes of the memory")


def observed(observer: Observer, matches: Correspondences, eyes: Eyes) -> Observations:
    """Correspondences (..., N) as Gaussians in the memory's chart, by the observer's cameras, retina and sigma points.

    Differentiable, see `torchfovea.sensing.triangulation.observe`.
    """
    for name, given, kind in (("matches", matches, Correspondences), ("eyes", eyes, Eyes)):
        require(isinstance(given, kind), name, type(given).__name__, f"a torchfovea.{kind.__name__}")
    support = matches.supported(observer.retina)
    chart = observer.fusion.chart
    return observe(matches, eyes, observer.cameras, support, observer.points, chart, observer.rotated)


@unrounded
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
    with compiling(observer.compile):
        seen = observed(observer, matches, eyes)
    sigma = math.radians(observer.head.encoder_deg)
    if common is None and sigma > 0:
        common = partial(encoder_covariance, eyes=eyes, sigma_rad=(sigma,) * 3, chart=observer.fusion.chart)
    axis = eyes.R_left[..., 2]
    kin = kinship(observer.budget, observer.retina, matches)
    if kin is not None and memory.axis is not None:
        # what looks at one place from one gaze share is all that its fields share
        same = torch.exp(-(((axis - memory.axis).norm(dim=-1, keepdim=True) / math.radians(SAME_GAZE_DEG)).square()))
        kin = kin._replace(lasting=kin.lasting + (kin.shared - kin.lasting).clamp(min=0) * same)
    with compiling(observer.compile):
        after = remember(memory, seen, observer.fusion, common, kin, matches.classes)
    if observer.fusion.votes:
        missed = within_sight(memory, after.looks == memory.looks, eyes, observer.cameras, observer.retina)
        after = after._replace(votes=against(after.votes, missed))
    return after._replace(axis=axis)


@unrounded
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
    sought = None if observer.classes is None else observer.classes.sought
    with compiling(observer.compile):
        appraised = appraise(memory, observer.reward, sought, observer.head, observer.eligibility)
    points, reward, open_to_looks, target, eligible, incumbent = appraised
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
