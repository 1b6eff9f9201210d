"""The paths of one saccade, correspondences to the next fixation, beside their peers, on one synthetic look."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchfovea.association import Pairs, associate, gather_columns
from torchfovea.bench import peers
from torchfovea.bench.timing import Growth, Path, Peer, nbytes, same
from torchfovea.chart import basis
from torchfovea.correspondence import Correspondences
from torchfovea.egosphere import Prior, belief, fuse, new_egosphere
from torchfovea.gaussian import Gaussian, columns, pack, unpack
from torchfovea.geometric import correspond_points
from torchfovea.head import Eyes, eyes, fixate, to_ego
from torchfovea.nearest import nearest_cell
from torchfovea.perception import Mind, Observer, decide, new_mind, perceive
from torchfovea.pooling import pool, pool_patches
from torchfovea.triangulation import Observations, observe
from torchfovea.unscented import SigmaPoints

__all__ = ["Saccade", "batch_of", "batched_steps", "paths_of_saccade", "saccade"]

_LOOPED, _FORCED = 200, 2000  # receptive fields that the slow peers go through


class Saccade(NamedTuple):
    """What a saccade starts from.

    Attributes:
        observer: of patches, without what its peers do not do.
        mind: an empty memory.
        matches: of a look (N,).
        pose: of the eyes.
    """

    observer: Observer
    mind: Mind
    matches: Correspondences
    pose: Eyes


def _moved(value: Any, device: str) -> Any:
    if isinstance(value, tuple):
        return type(value)(*(_moved(part, device) for part in value))
    return value.to(device) if isinstance(value, Tensor) else value


def saccade(observer: Observer, cells: Tensor, device: str = "cpu", seed: int = 0) -> Saccade:
    """A look of both eyes at a rolling surface, with noise, and an empty memory over `cells` (Nx, 3)."""
    gaze = fixate(observer.head, torch.tensor([1.2, 0.25, -0.1]))[0]
    pose = eyes(observer.head, gaze)
    left = observer.retina.centers_px("cpu", torch.float32)
    ray = torch.nn.functional.normalize(to_ego(pose.R_left, observer.camera.rays(left)), dim=-1)
    distance = 1.5 + 0.3 * torch.sin(3 * ray[:, 1:2]) + 0.2 * torch.cos(5 * ray[:, 2:])
    points = pose.t_left + distance * ray
    seen = torch.ones(len(left), dtype=torch.bool)
    generator = torch.Generator().manual_seed(seed)
    matches = correspond_points(
        points, seen, left, pose, observer.camera, observer.retina, observer.budget, generator
    )
    return _moved(Saccade(observer, new_mind(observer, cells), matches, pose), device)


def _part(look: Saccade, count: int) -> Saccade:
    """The same with receptive fields drawn evenly from all of them."""
    every = torch.linspace(0, look.matches.valid.shape[-1] - 1, count).long().to(look.matches.valid.device)
    kept = [part[every] for part in look.matches]
    kept = [columns(*part.unbind(-1)) if part.dim() == 2 else part for part in kept]
    return look._replace(matches=Correspondences(*kept))


def _support(look: Saccade) -> Tensor:
    return look.observer.retina.width_px(look.matches.left_px) / 2


def _observe(look: Saccade, support: Tensor) -> Observations:
    return observe(look.matches, look.pose, look.observer.camera, support)


def _flat(matches: Correspondences) -> tuple[Tensor, Tensor]:
    """Places (N, 4) and standard deviations (N, 2), contiguous, as the peers want them."""
    px = torch.cat([matches.left_px, matches.right_px], -1).contiguous()
    return px, torch.stack([matches.left_sigma_px, matches.right_sigma_px], -1)


def _shares(most: int) -> tuple[int, ...]:
    return tuple(max(64, most // share) for share in (4, 2, 1))


def _triangulate(look: Saccade) -> Path:
    points, device = SigmaPoints(), str(look.matches.valid.device)
    support = _support(look)
    rig = peers.rig_of(look.pose, look.observer.camera.focal_px)
    px, sigma = _flat(look.matches)
    tensors = peers.converted(rig, lambda a: torch.from_numpy(a).to(px))
    count = len(px)
    some = torch.linspace(0, count - 1, min(_LOOPED, count)).long().to(px.device)
    few = [part[some].cpu().numpy() for part in (px, sigma)]

    def check() -> None:
        ours, theirs = _observe(look, support), peers.unscented(torch, px, sigma, tensors, points)
        looped = peers.filterpy_loop(*few, rig, points)
        valid = ours.valid & theirs.valid
        same("triangulate_ut", ours.valid[look.matches.valid].float(), theirs.valid[look.matches.valid].float(), 0, 0.99)
        for index, other in ((valid.nonzero()[:, 0], theirs), (some[valid[some]], looped)):
            rows = index if other is theirs else valid[some].cpu()
            scale = unpack(ours.cov[index]).diagonal(dim1=-2, dim2=-1).sqrt().cpu()
            mean, cov = (torch.as_tensor(part)[rows].cpu() for part in (other.mean, other.cov))
            same("triangulate_ut", ours.direction[index], torch.as_tensor(other.direction)[rows], 1e-5)
            same("triangulate_ut", (ours.mean[index].cpu() - mean) / scale, torch.zeros_like(scale), 0.02, 0.999)
            unit = scale[:, :, None] * scale[:, None]
            same("triangulate_ut", unpack(ours.cov[index]).cpu() / unit, cov / unit, 0.02, 0.999)

    grown = [_part(look, size) for size in _shares(count)]
    growth = Growth(
        "RFs", _shares(count), tuple(partial(_observe, part, _support(part)) for part in grown)
    )
    return Path(
        "triangulate_ut",
        f"{count} RFs",
        device,
        partial(_observe, look, support),
        (
            Peer("batched torch, whole matrices", partial(peers.unscented, torch, px, sigma, tensors, points)),
            Peer(
                f"filterpy loop, {len(some)} of them scaled",
                partial(peers.filterpy_loop, *few, rig, points),
                count / len(some),
            ),
        ),
        check,
        nbytes(look.matches, support, _observe(look, support)),
        (growth,),
    )


def _align(look: Saccade) -> Path:
    found = _observe(look, _support(look))
    cells, lookup = look.mind.memory.cells, look.mind.lookup
    directions = columns(*found.direction[found.valid].unbind(-1))
    rows, count = directions.cpu().contiguous(), len(directions)
    tree = cKDTree(cells.cpu().double().numpy())
    plain = rows.numpy()
    few = directions[:: max(1, count // _FORCED)].contiguous()
    table = cells.contiguous()

    def cosines(which: Tensor, asked: Tensor) -> Tensor:
        return (table[which].double() * asked.double()).sum(-1)

    def check() -> None:
        cell, cosine = nearest_cell(lookup, directions)
        theirs = torch.from_numpy(tree.query(plain)[1]).to(cell)
        same("align", cosines(cell, directions), cosines(theirs, directions), 4e-7)
        same("align", cosine, cosines(theirs, directions), 1e-6)
        forced = peers.brute_force(table, few)
        same("align", cosines(nearest_cell(lookup, few)[0], few), cosines(forced, few), 4e-7)

    sizes = _shares(count)
    by_count = tuple(partial(nearest_cell, lookup, columns(*directions[:size].unbind(-1))) for size in sizes)
    cell_sizes = _shares(len(cells))
    by_cells = tuple(
        partial(nearest_cell, _moved(new_mind(look.observer, cells[:size].cpu()), str(cells.device)).lookup, directions)
        for size in cell_sizes
    )
    return Path(
        "align",
        f"{count} directions to {len(cells)} cells",
        str(cells.device),
        partial(nearest_cell, lookup, directions),
        (
            Peer("cKDTree, two workers", partial(tree.query, plain, workers=2)),
            Peer("brute force, a part scaled", partial(peers.brute_force, table, few), count / len(few)),
        ),
        check,
        nbytes(directions, cells, *nearest_cell(lookup, directions)),
        (Growth("RFs", sizes, by_count), Growth("cells", cell_sizes, by_cells)),
    )


def _fuse(look: Saccade) -> list[Path]:
    found = _observe(look, _support(look))
    cells, device, prior = look.mind.memory.cells, str(look.mind.memory.cells.device), look.observer.prior
    pairs = _pairs(look, found)
    chosen = gather_columns(found.direction, pairs.observation)
    own, count = gather_columns(cells, pairs.cell), len(cells)
    rho, spread, bearing = (
        part.reshape(-1)[pairs.observation] for part in (found.mean[..., 2], found.cov[..., 5], 2 / (found.cov[..., 0]))
    )
    row = columns(*((chosen * axis).sum(-1) for axis in (*basis(own), own)))
    keep, batch = torch.ones_like(rho), torch.Size([])

    # points, as printed: any covariances will do, so take the observations' own shapes about the points
    gaussian = Gaussian(columns(*(chosen / rho.clamp(min=0.05)[:, None]).unbind(-1)), _shaped(chosen, rho, spread))
    square, mean, memory = unpack(gaussian.cov).contiguous(), gaussian.mean.contiguous(), new_egosphere(cells, Prior(), "cartesian")
    vector, matrix = memory.information.vector.contiguous(), unpack(memory.information.matrix).contiguous()

    def points() -> Gaussian:
        return belief(fuse(memory, pool(gaussian, pairs.cell, batch, count)))

    patches = new_egosphere(cells, prior)
    rows = row.contiguous()
    first, second = patches.information.vector.contiguous(), unpack(patches.information.matrix).contiguous()

    def planes() -> Gaussian:
        return belief(fuse(patches, pool_patches(rho, spread, bearing, row, keep, pairs.cell, batch, count)))

    others = (
        partial(peers.fuse_gaussians, mean, square, pairs.cell, vector, matrix),
        partial(peers.fuse_patches, rows, rho, spread, pairs.cell, first, second),
    )

    def check(ours: Any, other: Any) -> None:
        here, there = ours(), other()
        scale = unpack(here.cov).diagonal(dim1=-2, dim2=-1).sqrt()
        unit = scale[:, :, None] * scale[:, None]
        same("fuse", (here.mean - there[0]) / scale, torch.zeros_like(scale), 0.1, 0.999)
        same("fuse", unpack(here.cov) / unit, there[1] / unit, 0.02, 0.999)

    rows_of = f"{len(pairs.cell)} %s into {count} cells, and their moments"
    name = "index_add_ of 3x3 blocks, linalg.inv"
    inputs = (nbytes(gaussian, memory.information), nbytes(rho, spread, bearing, row, patches.information))
    sizes = _shares(len(pairs.cell))

    def part(size: int) -> Any:
        less = Gaussian(*(columns(*p[:size].unbind(-1)) for p in gaussian))
        return lambda: belief(fuse(memory, pool(less, pairs.cell[:size], batch, count)))

    return [
        Path(
            "fuse", rows_of % what, device, ours, (Peer(name, other),), partial(check, ours, other),
            moved + nbytes(pairs.cell, ours()), growths,
        )
        for what, ours, other, moved, growths in (
            ("points", points, others[0], inputs[0], (Growth("RFs", sizes, tuple(map(part, sizes))),)),
            ("patches", planes, others[1], inputs[1], ()),
        )
    ]  # fmt: skip


def _shaped(direction: Tensor, rho: Tensor, variance: Tensor) -> Tensor:
    """Packed covariances (M, 6) as long as they are uncertain in range and a tenth of that across."""
    along = variance / rho.clamp(min=0.05) ** 4
    across = along / 100
    outer = direction[:, :, None] * direction[:, None] * (along - across)[:, None, None]
    return pack(outer + across[:, None, None] * torch.eye(3).to(outer))


def _pairs(look: Saccade, found: Observations) -> Pairs:
    fusion, mind = look.observer.fusion, look.mind
    gate = math.radians(fusion.gate_deg)
    return associate(
        mind.memory.cells, mind.lookup, mind.spacing_rad, found, gate, fusion.gate_spacing, fusion.fill
    )


def _known(mind: Mind) -> tuple[np.ndarray, ...]:
    """Cells, information and counts in NumPy, the matrices whole."""
    memory = mind.memory
    parts = (memory.cells, memory.information.vector, unpack(memory.information.matrix), memory.bearing)
    return (*(part.cpu().contiguous().numpy() for part in parts), (memory.looks > 0).cpu().numpy())


def _limits(observer: Observer) -> tuple[float, float]:
    return observer.eligibility.nearest_m, observer.eligibility.ground_z_m


def _same_choice(what: str, ours: Any, theirs: peers.Choice, share: float) -> None:
    """Rewards and eligibility agree, and our cell is as good as the peer's best."""
    same(what, ours.reward.mean, theirs.rho, 1e-3, share)
    same(what, ours.reward.std, theirs.std, 1e-3, share)
    same(what, ours.eligible.float(), np.isfinite(theirs.score).astype(np.float32), 0, share)
    near = (ours.reward.mean > 0.2).cpu()
    same(what, ours.points.mean.cpu()[near], theirs.points[near.numpy()], 1e-2, share)
    same(what, theirs.score[int(ours.cell)], theirs.score[theirs.cell], 5e-3)


def _decide(look: Saccade) -> Path:
    observer, mind = look.observer, perceive(look.observer, look.mind, look.matches, look.pose)
    prior = (observer.prior.mean, observer.prior.std)
    theirs = partial(peers.decide, *_known(mind), observer.head, prior, _limits(observer))
    ours = partial(decide, observer, mind)

    def check() -> None:
        _same_choice("decide", ours(), theirs(), 0.999)

    sizes = _shares(mind.memory.cells.shape[0])

    def part(size: int) -> Any:
        memory = mind.memory
        less = memory._replace(
            cells=columns(*memory.cells[:size].unbind(-1)),
            information=type(memory.information)(*(columns(*p[:size].unbind(-1)) for p in memory.information)),
            bearing=memory.bearing[:size],
            looks=memory.looks[:size],
        )
        return partial(decide, observer, mind._replace(memory=less))

    done = ours()
    return Path(
        "decide",
        f"{len(mind.memory.cells)} cells",
        str(mind.memory.cells.device),
        ours,
        (Peer("NumPy, linalg.inv", theirs),),
        check,
        nbytes(mind.memory, done.points, done.reward, done.eligible),
        (Growth("cells", sizes, tuple(map(part, sizes))),),
    )


def _one_step(look: Saccade) -> Any:
    return decide(look.observer, perceive(look.observer, look.mind, look.matches, look.pose))


def _step(look: Saccade, full: Observer) -> list[Path]:
    observer, mind = look.observer, look.mind
    cells, vector, matrix, bearing, _ = _known(mind)
    px, sigma = (part.cpu().numpy() for part in _flat(look.matches))
    rig = peers.converted(peers.rig_of(look.pose, observer.camera.focal_px), lambda a: a.astype(px.dtype))
    support = _observe(look, _support(look)).support_rad.cpu().numpy()
    gates = (math.radians(observer.fusion.gate_deg), observer.fusion.gate_spacing)
    theirs = partial(
        peers.step, px, sigma, support, look.matches.valid.cpu().numpy(), rig, SigmaPoints(), cKDTree(cells),
        peers.tangent_frames(np, cells), mind.spacing_rad.cpu().numpy(), gates, vector, matrix, bearing,
        observer.prior.slope_std, observer.head, (observer.prior.mean, observer.prior.std), _limits(observer),
    )  # fmt: skip
    ours = partial(_one_step, look)

    def check() -> None:
        _same_choice("step", ours(), theirs(), 0.99)

    def check_full() -> None:
        if int(_one_step(look._replace(observer=full)).cell) < 0:
            raise RuntimeError("step: nothing to fixate")

    done, device = ours(), str(mind.memory.cells.device)
    work = f"{len(px)} RFs to {len(cells)} cells to the next fixation"
    sizes, cell_sizes = _shares(len(px)), _shares(len(cells))
    by_cells = tuple(
        partial(_one_step, look._replace(mind=_moved(new_mind(observer, mind.memory.cells[:n].cpu()), device)))
        for n in cell_sizes
    )
    growths = (
        Growth("RFs", sizes, tuple(partial(_one_step, _part(look, n)) for n in sizes)),
        Growth("cells", cell_sizes, by_cells),
    )
    moved = nbytes(look.matches, mind.memory, done.mind.memory, done.points, done.reward, done.eligible)
    return [
        Path("step", work, device, ours, (Peer("NumPy and SciPy, vectorized", theirs),), check, moved, growths),
        Path(
            "step", work + ", with fill and conflicts", device, partial(_one_step, look._replace(observer=full)), (),
            check_full, moved,
        ),
    ]  # fmt: skip


def batch_of(looks: Sequence[Saccade]) -> Saccade:
    """Saccades of equal sizes as one, memories indexed together."""
    first = looks[0]
    cells = torch.stack([look.mind.memory.cells.cpu() for look in looks])
    device = str(first.mind.memory.cells.device)
    matches = [torch.stack(parts) for parts in zip(*(look.matches for look in looks), strict=True)]
    matches = [columns(*part.unbind(-1)) if part.dim() == 3 else part for part in matches]
    pose = Eyes(*(torch.stack(parts) for parts in zip(*(look.pose for look in looks), strict=True)))
    mind = _moved(new_mind(first.observer, columns(*cells.unbind(-1))), device)
    return Saccade(first.observer, mind, Correspondences(*matches), pose)


def batched_steps(observer: Observer, cells: Tensor, batch: int, device: str) -> Path:
    """Geometric saccades of a batch together, against one by one."""
    alone = [saccade(observer, cells, device, seed) for seed in range(batch)]
    together = batch_of(alone)

    def loop() -> list[Any]:
        return [_one_step(look) for look in alone]

    def check() -> None:
        whole = _one_step(together)
        for b, part in enumerate(loop()):
            same("step of a batch", whole.reward.mean[b], part.reward.mean, 1e-3, 0.999)
            same("step of a batch", whole.reward.std[b], part.reward.std, 1e-3, 0.999)

    sizes = tuple(sorted({max(1, batch // share) for share in (4, 2, 1)}))
    runs = tuple(partial(_one_step, batch_of(alone[:size])) for size in sizes)
    done = _one_step(together)
    return Path(
        "step",
        f"batch of {batch}: {alone[0].matches.valid.shape[-1]} RFs to {len(cells)} cells, each",
        device,
        partial(_one_step, together),
        (Peer("one by one", loop),),
        check,
        nbytes(together.matches, together.mind.memory, done.mind.memory, done.points, done.reward, done.eligible),
        (Growth("batch", sizes, runs),) if len(sizes) > 1 else (),
        batch,
    )


def paths_of_saccade(look: Saccade, full: Observer) -> list[Path]:
    """Triangulation with its unscented transform, alignment, fusion, decision and the whole step.

    Args:
        look: from `saccade`, by an observer of patches without fill and conflicts.
        full: the observer with them.
    """
    return [_triangulate(look), _align(look), *_fuse(look), _decide(look), *_step(look, full)]
