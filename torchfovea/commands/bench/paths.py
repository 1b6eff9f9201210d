"""Triangulation, alignment and fusion of one look beside their peers."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torchfovea.commands.bench import peers
from torchfovea.commands.bench.look import Saccade, flat_of, part_of, shares, support_of
from torchfovea.commands.bench.timing import Growth, Path, Peer, compiled_peer, in_mode, nbytes, same
from torchfovea.gaussian import Gaussian, columns, pack, unpack
from torchfovea.memory.association import Pairs, associate, gather_columns
from torchfovea.memory.egosphere import Memory, Prior, belief, empty_memory
from torchfovea.memory.nearest import nearest_cell
from torchfovea.memory.pooling import pool, pool_patches
from torchfovea.memory.update import fuse
from torchfovea.perception import new_memory
from torchfovea.rows import to_device
from torchfovea.sensing.chart import basis
from torchfovea.sensing.triangulation import Observations, observe
from torchfovea.sensing.unscented import SigmaPoints

__all__ = ["paths_of_look"]

_LOOPED, _FORCED = 100, 1000  # receptive fields that the slow peers go through


def _observe(look: Saccade, support: Tensor) -> Observations:
    return observe(look.matches, look.pose, look.observer.camera, support)


def _triangulate(look: Saccade) -> Path:
    points, device = SigmaPoints(), str(look.matches.valid.device)
    support = support_of(look)
    rig = peers.rig_of(look.pose, look.observer.camera.focal_px)
    px, sigma = flat_of(look.matches)
    tensors = peers.converted(rig, lambda a: torch.from_numpy(a).to(px))
    count = len(px)
    some = torch.linspace(0, count - 1, min(_LOOPED, count)).long().to(px.device)
    loop = partial(peers.filterpy_loop, px[some].cpu().numpy(), sigma[some].cpu().numpy(), rig, points)

    def check() -> None:
        ours, theirs = _observe(look, support), peers.unscented(torch, px, sigma, tensors, points)
        looped = loop()
        valid = ours.valid & theirs.valid
        same(
            "triangulate_ut", ours.valid[look.matches.valid].float(), theirs.valid[look.matches.valid].float(), 0, 0.99
        )
        for index, other in ((valid.nonzero()[:, 0], theirs), (some[valid[some]], looped)):
            rows = index if other is theirs else valid[some].cpu()
            scale = unpack(ours.cov[index]).diagonal(dim1=-2, dim2=-1).sqrt().cpu()
            mean, cov = (torch.as_tensor(part)[rows].cpu() for part in (other.mean, other.cov))
            same("triangulate_ut", ours.direction[index], torch.as_tensor(other.direction)[rows], 1e-5)
            same("triangulate_ut", (ours.mean[index].cpu() - mean) / scale, torch.zeros_like(scale), 0.02, 0.999)
            unit = scale[:, :, None] * scale[:, None]
            same("triangulate_ut", unpack(ours.cov[index]).cpu() / unit, cov / unit, 0.02, 0.999)

    grown = [part_of(look, size) for size in shares(count)]
    growth = Growth("RFs", shares(count), tuple(partial(_observe, part, support_of(part)) for part in grown))
    return Path(
        "triangulate_ut",
        f"{count} RFs",
        device,
        partial(_observe, look, support),
        (
            Peer("batched torch, whole matrices", partial(peers.unscented, torch, px, sigma, tensors, points)),
            Peer(f"filterpy loop, {len(some)} of them scaled", loop, count / len(some)),
            *compiled_peer(look.compile, lambda mode: partial(in_mode, mode, _observe, look, support)),
        ),
        check,
        nbytes(look.matches, support, _observe(look, support)),
        (growth,),
    )


def _align(look: Saccade) -> Path:
    found = _observe(look, support_of(look))
    cells, lookup = look.memory.cells, look.memory.lookup
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

    sizes = shares(count)
    by_count = tuple(partial(nearest_cell, lookup, columns(*directions[:size].unbind(-1))) for size in sizes)
    cell_sizes = shares(len(cells))
    by_cells = tuple(
        partial(
            nearest_cell, to_device(new_memory(look.observer, cells[:size].cpu()), str(cells.device)).lookup, directions
        )
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
    found = _observe(look, support_of(look))
    cells, device, prior = look.memory.cells, str(look.memory.cells.device), look.observer.prior
    pairs = _pairs(look, found)
    chosen = gather_columns(found.direction, pairs.observation)
    own, count = gather_columns(cells, pairs.cell), len(cells)
    rho, spread, bearing = (
        part.reshape(-1)[pairs.observation] for part in (found.mean[..., 2], found.cov[..., 5], 2 / (found.cov[..., 0]))
    )
    row = columns(*((chosen * axis).sum(-1) for axis in (*basis(own), own)))
    keep, shape = torch.ones_like(rho), (count,)

    # points, as printed: any covariances will do, so take the observations' own shapes about the points
    gaussian = Gaussian(columns(*(chosen / rho.clamp(min=0.05)[:, None]).unbind(-1)), _shaped(chosen, rho, spread))
    square, mean, memory = (
        unpack(gaussian.cov).contiguous(),
        gaussian.mean.contiguous(),
        empty_memory(cells, Prior(), "cartesian"),
    )
    vector, matrix = _blocks(memory)

    def points() -> Gaussian:
        return belief(fuse(memory, pool(gaussian, pairs.cell, shape)))

    patches = empty_memory(cells, prior)
    rows = row.contiguous()
    first, second = _blocks(patches)

    def planes() -> Gaussian:
        return belief(fuse(patches, pool_patches(rho, spread, bearing, row, keep, pairs.cell, shape)))

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
    sizes = shares(len(pairs.cell))

    def part(size: int) -> Any:
        less = Gaussian(*(columns(*p[:size].unbind(-1)) for p in gaussian))
        return lambda: belief(fuse(memory, pool(less, pairs.cell[:size], shape)))

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


def _blocks(memory: Memory) -> tuple[Tensor, Tensor]:
    """A memory's information in the cells' dtype, as peers keep it: (..., 3) and (..., 3, 3)."""
    vector, matrix = (part.to(memory.cells.dtype) for part in memory.information)
    return vector.contiguous(), unpack(matrix).contiguous()


def _shaped(direction: Tensor, rho: Tensor, variance: Tensor) -> Tensor:
    """Packed covariances (M, 6) as long as they are uncertain in range and a tenth of that across."""
    along = variance / rho.clamp(min=0.05) ** 4
    across = along / 100
    outer = direction[:, :, None] * direction[:, None] * (along - across)[:, None, None]
    return pack(outer + across[:, None, None] * torch.eye(3).to(outer))


def _pairs(look: Saccade, found: Observations) -> Pairs:
    fusion, memory = look.observer.fusion, look.memory
    gate = math.radians(fusion.gate_deg)
    return associate(memory.cells, memory.lookup, memory.spacing_rad, found, gate, fusion.gate_spacing, fusion.fill)


def paths_of_look(look: Saccade) -> list[Path]:
    """Triangulation with its unscented transform, alignment, fusion of points and of patches.

    Args:
        look: from `torchfovea.commands.bench.look.saccade`, by an observer of patches without fill and conflicts.
    """
    return [_triangulate(look), _align(look), *_fuse(look)]
