"""A memory that moves with the robot, and one whose cells are drawn anew: what is known goes over into other cells.

A patch is a plane q·X = 1, so that a rigid motion of the base, X = R X' + t, takes it to q' = Rᵀq/(1 − q·t), exactly.
Which cell it falls into, and what it hides there, is found anew (after Sec. 5.2 and 8).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torchfovea.gaussian import (
    Gaussian,
    Information,
    columns,
    gaussian_from_information,
    information_from_gaussian,
    pack,
    quadratic3,
    rotate3,
)
from torchfovea.memory.association import in_front
from torchfovea.memory.egosphere import Fusion, Memory, belief, check_chart, empty_memory, prior_information
from torchfovea.memory.nearest import nearest_cell, nearest_observation
from torchfovea.rounding import unrounded
from torchfovea.sensing.chart import basis
from torchfovea.setting import require

__all__ = ["Motion", "motion", "move", "resample"]


EDGE_ON = 4.0  # a slope so many times less certain than an unseen cell's is of a patch that is seen from its edge


class Motion(NamedTuple):
    """A step of the base as odometry tells it; build it with `motion`, which checks it.

    Attributes:
        rotation: (3, 3), columns are the new frame's axes in the old one: X_old = R X_new + t.
        translation: (3,), the new origin in the old frame [m].
        covariance: (6, 6) of the rotation vector [rad] and the translation [m], in the new frame.
    """

    rotation: Tensor
    translation: Tensor
    covariance: Tensor


def motion(rotation: Tensor, translation: Tensor, covariance: Tensor | None = None) -> Motion:
    """Check and build a step of the base.

    Args:
        rotation: see `Motion`.
        translation: see `Motion`.
        covariance: (6, 6), positive semi-definite; None: the step is known exactly.

    Returns:
        In float64, on the CPU.

    Raises:
        SettingError: for anything that is no rigid motion, or no covariance.
    """
    r, t = (torch.as_tensor(x).detach().to("cpu", torch.float64) for x in (rotation, translation))
    c = torch.zeros(6, 6, dtype=torch.float64) if covariance is None else torch.as_tensor(covariance).detach()
    c = c.to("cpu", torch.float64)
    right = r.shape == (3, 3) and bool(torch.isfinite(r).all())
    right = right and torch.allclose(r @ r.mT, torch.eye(3, dtype=r.dtype), atol=1e-4) and bool(torch.linalg.det(r) > 0)
    require(right, "motion.rotation", r.tolist(), "a rotation matrix (3, 3)")
    require(t.shape == (3,) and bool(torch.isfinite(t).all()), "motion.translation", t.tolist(), "three finite metres")
    good = c.shape == (6, 6) and bool(torch.isfinite(c).all()) and torch.allclose(c, c.mT, atol=1e-9)
    good = good and bool(torch.linalg.eigvalsh(c).min() >= -1e-12)
    require(good, "motion.covariance", c.tolist(), "a positive semi-definite matrix (6, 6)")
    return Motion(r, t, c)


def _check_one(memory: Memory, fusion: Fusion) -> None:
    """Refuse what can be neither moved nor resampled: beliefs of classes, batches, and a fusion of another chart."""
    require(memory.classes is None, "memory.classes", "a belief of classes", "none: it is neither moved nor resampled")
    check_chart(memory, fusion.chart, "fusion.chart")
    require(memory.cells.dim() == 2, "cells", tuple(memory.cells.shape), "one memory, a shape (cells, 3)")


def _frame(direction: Tensor) -> Tensor:
    """The cells' frames (..., 3, 3); rows are e₁, e₂ and the direction."""
    return torch.stack([*basis(direction), direction], -2)


def _skew(v: Tensor) -> Tensor:
    """The matrices [v]× (..., 3, 3), with [v]× w = v × w."""
    x, y, z = v.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([torch.stack(r, -1) for r in ((zero, -z, y), (z, zero, -x), (-y, x, zero))], -2)


class _Moved(NamedTuple):
    """Seen cells after a motion, before they are in cells again.

    Attributes:
        state: mean and packed covariance of points, or of planes q, in the new frame.
        direction: where they are seen, (M, 3).
        bearing: precision across the line of sight (M,).
        looks: (M,).
        lasting: see `Memory`, relative to the information of the inverse range, (M, 2).
        votes: (M, 2).
    """

    state: Gaussian
    direction: Tensor
    bearing: Tensor
    looks: Tensor
    lasting: Tensor
    votes: Tensor


def _carry(memory: Memory, step: Motion) -> _Moved:
    """Move what was seen but patches whose back or edge the robot would see now. Float64: planes mix scales."""
    moments = gaussian_from_information(memory.information)
    rotation = step.rotation.mT.to(memory.cells.device)
    shift, noise = step.translation.to(memory.cells.device), step.covariance.to(memory.cells.device)
    seen, chart = memory.looks > 0, memory.chart
    if chart == "inverse_range":
        seen = seen & (moments.mean[..., 2] > 1e-3)
    cells, mean, cov = memory.cells[seen].double(), moments.mean[seen], moments.cov[seen]
    looks, bearing = memory.looks[seen], memory.bearing[seen].double()
    if chart == "cartesian":
        point = (mean - shift) @ rotation.mT
        state = Gaussian(point, rotate3(rotation.expand(len(point), 3, 3), cov))
        facing = torch.ones_like(looks, dtype=torch.bool)
    else:
        frame = _frame(cells).mT
        q = (frame @ mean[..., None])[..., 0]
        left = 1 - q @ shift
        facing = left > 1e-3
        left = torch.where(facing, left, torch.ones_like(left))[:, None, None]
        jacobian = rotation @ (torch.eye(3, dtype=q.dtype, device=q.device) / left + q[..., None] * shift / left**2)
        point = (cells / mean[..., 2:] - shift) @ rotation.mT
        state = Gaussian((q @ rotation.mT) / left[..., 0], rotate3(jacobian @ frame, cov))
    square = (point * point).sum(-1)
    turned = torch.cat(
        [-_skew(point), torch.eye(3, dtype=point.dtype, device=point.device).expand(len(point), 3, 3)], -1
    )
    drift = pack(turned @ noise @ turned.mT)
    direction = point * square.rsqrt()[..., None]
    if chart == "inverse_range":
        across = (drift[..., 0] + drift[..., 3] + drift[..., 5] - quadratic3(drift, direction)) / (2 * square)
        bearing = 1 / (1 / (bearing * mean[..., 2] ** 2 * square) + across)
        q = state.mean
        turned = torch.cat([-_skew(q), -q[..., :, None] * q[..., None, :]], -1)
        drift = pack(turned @ noise @ turned.mT)
    state = Gaussian(state.mean, state.cov + drift)
    if chart == "inverse_range":
        # nearly edge-on the slope blows up beyond what planes can have, and nothing is left of it in float32
        wild = state.cov[..., 0] + state.cov[..., 3] + state.cov[..., 5] - quadratic3(state.cov, direction)
        facing = facing & (wild < 2 * (EDGE_ON * memory.prior.slope_std) ** 2)
    good = facing & (square > 1e-6) & torch.isfinite(state.cov).all(-1) & torch.isfinite(state.mean).all(-1)
    lasting = memory.lasting[seen].double() * columns(cov[..., 5].sqrt(), cov[..., 5])
    rows = (part[good] for part in (direction, bearing, looks, lasting, memory.votes[seen]))
    return _Moved(Gaussian(state.mean[good], state.cov[good]), *rows)


@unrounded
def move(memory: Memory, step: Motion, fusion: Fusion) -> Memory:
    """Carry one memory along with the base.

    Each seen cell's point or patch is moved with its covariance (the rotation exactly, the odometry's covariance added)
    and finds its new cell. Of several in one cell those that a nearer one hides are left out, and of the rest the one
    closest to the cell's direction stays *alone*: neighbours share the odometry's error, so that their sum would claim
    too much. A cell that got nothing takes the nearest patch within 1.5 spacings. Cells that nothing moved into are
    unseen.

    Args:
        memory: before, (Nx, 3).
        step: from `motion`.
        fusion: whose conflict holds.

    Returns:
        The memory over the same directions in the new frame. Not differentiable.

    Raises:
        SettingError: for a batch of memories, or a fusion of another chart.
    """
    require(isinstance(step, Motion), "step", type(step).__name__, "a torchfovea.Motion, made by motion")
    _check_one(memory, fusion)
    cells, spacing_rad = memory.cells, memory.spacing_rad
    moved, empty = _carry(memory, step), _emptied(memory)
    if memory.axis is not None:
        empty = empty._replace(axis=(step.rotation.mT.to(memory.axis) @ memory.axis[:, None])[:, 0])
    if len(moved.looks) == 0:
        return empty
    direction = moved.direction.to(cells)
    cell, cosine = nearest_cell(memory.lookup, direction)
    near = torch.acos(cosine.clamp(-1, 1)) <= 1.5 * spacing_rad[cell].clamp(max=math.pi / 2)
    taken = near.nonzero().squeeze(1)
    home = cell[taken]
    rho, variance = _seen_from(moved, taken, cells[home], memory.chart)
    # the outermost patch of a thing ends half a spacing beyond itself: farther it hides nothing, or things would grow
    apart = (direction[taken] - cells[home]).norm(dim=-1)
    hides = apart <= 0.5 * spacing_rad[home]
    visible = in_front(rho, variance.sqrt(), home, len(cells), fusion.conflict, hides)
    closest = torch.full((len(cells),), math.inf, dtype=cells.dtype, device=cells.device)
    closest = closest.scatter_reduce(0, home[visible], apart[visible], "amin")
    source = torch.full((len(cells),), -1, dtype=torch.int64, device=cells.device)
    winner = visible & (apart == closest[home])
    source = source.scatter_reduce(0, home[winner], taken[winner], "amax")
    shown = torch.ones_like(near)
    shown[taken[~visible]] = False
    free = source < 0
    candidate, cosine = nearest_observation(
        torch.where(shown[:, None], direction, torch.zeros_like(direction)), cells, 1.5 * spacing_rad, wanted=free
    )
    source = torch.where(free & (cosine > -1), candidate, source)
    got = (source >= 0).nonzero().squeeze(1)
    return _put(empty, got, moved, source[got])


def _emptied(memory: Memory) -> Memory:
    """The same cells, unseen."""
    first, bearing = prior_information(memory.cells, memory.prior, memory.chart)
    nothing = torch.zeros_like(memory.looks)
    none = columns(nothing, nothing)
    return memory._replace(information=first, bearing=bearing, looks=nothing, lasting=none, votes=none)


def _seen_from(moved: _Moved, which: Tensor, target: Tensor, chart: str) -> tuple[Tensor, Tensor]:
    """Inverse range and its variance in the directions of the cells that take them, (M,) each."""
    mean, cov, target = moved.state.mean[which], moved.state.cov[which], target.double()
    if chart == "inverse_range":
        return (mean * target).sum(-1), quadratic3(cov, target)
    r = mean.norm(dim=-1)
    return 1 / r, quadratic3(cov, mean / r[..., None]) / r**4


def _put(empty: Memory, got: Tensor, moved: _Moved, source: Tensor) -> Memory:
    """Write moved states into cells of an empty memory."""
    mean, cov = moved.state.mean[source], moved.state.cov[source]
    if empty.chart == "inverse_range":
        frame = _frame(empty.cells[got].double())
        mean, cov = (frame @ mean[..., None])[..., 0], rotate3(frame, cov)
    new = information_from_gaussian(Gaussian(mean, cov))
    information = Information(*(_write(old, got, part) for old, part in zip(empty.information, new, strict=True)))
    bearing = _write(empty.bearing, got, moved.bearing[source])
    looks, votes = _write(empty.looks, got, moved.looks[source]), _write(empty.votes, got, moved.votes[source])
    lasting = moved.lasting[source] / columns(cov[..., 5].sqrt(), cov[..., 5])
    lasting = _write(empty.lasting, got, lasting)
    return empty._replace(information=information, bearing=bearing, looks=looks, lasting=lasting, votes=votes)


def _write(old: Tensor, rows: Tensor, values: Tensor) -> Tensor:
    """A copy of old with other rows, in old's dtype."""
    new = old.clone()
    new[rows] = values.to(old.dtype)
    return new


@unrounded
def resample(memory: Memory, cells: Tensor, fusion: Fusion) -> Memory:
    """Carry what is known over to another set of cells, conserving information (Sec. 8).

    Every seen cell's information beyond the prior goes to the new cell nearest to it, and to new cells that would stay
    empty and have it nearest, in equal shares; what a nearer surface of the same new cell hides is left out. The new
    cells' information beyond the prior sums up to the old cells' (in the Cartesian chart, and of inverse range in the
    other, where it turns with the frames).

    Args:
        memory: before, (Nx, 3).
        cells: the new unit directions (Ny, 3).
        fusion: whose conflict holds.

    Returns:
        The memory over the new cells. Not differentiable.

    Raises:
        SettingError: for a batch of memories, cells that are not unit directions or a fusion of another chart.
    """
    _check_one(memory, fusion)
    chart, prior, spacing_rad = memory.chart, memory.prior, memory.spacing_rad
    require(cells.dim() == 2, "cells", tuple(cells.shape), "directions of one memory, a shape (cells, 3)")
    cells = cells.to(memory.cells.dtype) if cells.dtype in (torch.float32, torch.float64) else cells
    empty = empty_memory(cells, prior, chart)._replace(axis=memory.axis)
    old = (memory.looks > 0).nonzero().squeeze(1)
    if len(old) == 0:
        return empty
    target = nearest_cell(empty.lookup, memory.cells[old])[0]
    moments = belief(memory)
    if chart == "inverse_range":
        std = (moments.cov[old, 5] + prior.slope_std**2 * (cells[target] - memory.cells[old]).square().sum(-1)).sqrt()
        visible = in_front(moments.mean[old, 2], std, target, len(cells), fusion.conflict)
        old, target = old[visible], target[visible]
    free = torch.ones(len(cells), dtype=torch.bool, device=cells.device)
    free[target] = False
    reach = float(1.5 * spacing_rad[old].clamp(max=math.pi / 2).max())
    nearest, cosine = nearest_observation(memory.cells[old], cells, reach, wanted=free)
    extra = (free & (cosine > -1)).nonzero().squeeze(1)
    extra = extra[torch.acos(cosine[extra].clamp(-1, 1)) <= 1.5 * spacing_rad[old[nearest[extra]]]]
    source, target = torch.cat([old, old[nearest[extra]]]), torch.cat([target, extra])
    share = 1 / torch.bincount(source, minlength=len(memory.cells))[source].double()
    first, bearing = prior_information(memory.cells, prior, chart)
    vector, matrix = ((now - then)[source] for now, then in zip(memory.information, first, strict=True))
    if chart == "inverse_range":
        turn = _frame(cells[target].double()) @ _frame(memory.cells[source].double()).mT
        vector, matrix = (turn @ vector[..., None])[..., 0], rotate3(turn, matrix)
    sums = [vector, matrix, (memory.bearing - bearing).double()[source][:, None]]
    parts = torch.cat([*sums, memory.lasting.double()[source], memory.votes.double()[source]], -1) * share[:, None]
    parts[:, 11] *= share  # the second sum of `lasting` is of squares
    total = columns(*parts.new_zeros(len(cells), 14).index_add(0, target, parts).unbind(-1))
    information = Information(empty.information.vector + total[..., :3], empty.information.matrix + total[..., 3:9])
    total = total.to(cells.dtype)
    looks = empty.looks.scatter_reduce(0, target, memory.looks[source], "amax")
    lasting, votes = columns(*total[..., 10:12].unbind(-1)), columns(*total[..., 12:].unbind(-1))
    return empty._replace(
        information=information, bearing=empty.bearing + total[..., 9], looks=looks, lasting=lasting, votes=votes
    )
