"""What class of thing each cell shows: a Dirichlet belief, to which every look adds what its fields could tell.

As Luzio, Bernardino, Moreno (2024) fuse a foveated classifier's scores: a cell's shares θ of the classes have a
Dirichlet belief. A look whose evidence has the likelihood l makes of it a mixture of Dirichlets, of which the one with
the same mean and the same sum of variances is kept (Kaplan, Sensoy, Chakraborty, de Mel 2015). A look that tells
nothing changes nothing, however often it is repeated.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torchfovea.memory.association import Pairs
from torchfovea.setting import check_types, require

__all__ = ["Classes", "Evidence", "class_moments", "join_evidence", "new_classes"]

Evidence = Callable[[Any, Any, Any], Tensor]
"""From views (`torchfovea.stereo.views.Views`), a retina and its matches to how likely what each field shows is for
each class, (N, K)."""


@dataclass(frozen=True)
class Classes:
    """Which classes there are, and which is sought.

    Attributes:
        count: K, class 0 being whatever is no marked object.
        sought: the class whose nearest member is the task.
        prior: concentration of an unseen cell's Dirichlet belief, summed over the classes; the smaller, the more one
            look counts.
        evidence: what tells the classes in pictures; None: nothing does, the geometric sensor's marks aside.
    """

    count: int = 2
    sought: int = 1
    prior: float = 0.2
    evidence: Evidence | None = None

    def __post_init__(self) -> None:
        """Raise SettingError for classes that are none."""
        check_types(self, "reward.")
        require(2 <= self.count <= 64, "reward.count", self.count, "2 to 64 classes")
        inside = 0 < self.sought < self.count
        require(inside, "reward.sought", self.sought, f"a class that an object has, 1 to {self.count - 1}")
        require(1e-3 <= self.prior <= 1e3, "reward.prior", self.prior, "a concentration, 0.001 to 1000")
        form = "a function (views, retina, matches) that returns likelihoods (N, K)"
        require(self.evidence is None or callable(self.evidence), "reward.evidence", type(self.evidence).__name__, form)


def new_classes(classes: Classes, cells: Tensor) -> Tensor:
    """The Dirichlet parameters (..., Nx, K) of cells (..., Nx, 3) that nobody has looked at: all classes alike."""
    return cells.new_full((*cells.shape[:-1], classes.count), classes.prior / classes.count)


def join_evidence(belief: Tensor, likelihood: Tensor, pairs: Pairs) -> Tensor:
    """Enter a look's evidence of class.

    The fields of one cell see one thing and err together: a look's evidence is the geometric mean of theirs, one
    observation.

    Args:
        belief: Dirichlet parameters (..., Nx, K).
        likelihood: of each observation under every class, positive (..., N, K).
        pairs: which observation falls on which cell.

    Returns:
        (..., Nx, K). Differentiable in the belief and the likelihoods.
    """
    count = belief.shape[-1]
    shown = likelihood.reshape(-1, count).index_select(0, pairs.observation).to(belief).log()
    flat = belief.reshape(-1, count)
    total = torch.zeros_like(flat).index_add(0, pairs.cell, shown)
    fields = torch.zeros_like(flat[:, 0]).index_add(0, pairs.cell, torch.ones_like(shown[:, 0]))
    evidence = (total / fields.clamp(min=1)[:, None]).exp()
    fresh = torch.where((fields > 0)[:, None], _matched(flat, evidence), flat)
    return fresh.reshape(belief.shape)


def _matched(alpha: Tensor, likelihood: Tensor) -> Tensor:
    """The Dirichlet of the same mean and sum of squares as Σ_k w_k Dir(α + e_k), w_k ∝ α_k l_k."""
    weight = alpha * likelihood
    weight = weight / weight.sum(-1, keepdim=True)
    total = alpha.sum(-1, keepdim=True)
    mean = (alpha + weight) / (total + 1)
    square = (alpha * (alpha + 1) + 2 * weight * (alpha + 1)) / ((total + 1) * (total + 2))
    spread = (square - mean.square()).sum(-1, keepdim=True)
    room = (mean - mean.square()).sum(-1, keepdim=True)
    return mean * (room / spread - 1)


def class_moments(belief: Tensor, sought: int) -> tuple[Tensor, Tensor]:
    """Mean and variance (..., Nx) of the share of a class, from Dirichlet parameters (..., Nx, K). Differentiable."""
    total = belief.sum(-1)
    mean = belief[..., sought] / total
    return mean, mean * (1 - mean) / (total + 1)
