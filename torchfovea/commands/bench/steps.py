"""The decision and whole steps, correspondences to the next fixation, beside their peers."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from torch import Tensor

from torchfovea.commands.bench import peers
from torchfovea.commands.bench.look import (
    Saccade,
    batch_of,
    flat_of,
    part_of,
    saccade,
    shares,
    support_of,
)
from torchfovea.commands.bench.timing import Growth, Path, Peer, compiled_peer, nbytes, same
from torchfovea.deciding.strategies import Strategy, upper_confidence_bound
from torchfovea.gaussian import columns, unpack
from torchfovea.memory.cell_index import CellIndex
from torchfovea.memory.egosphere import Memory
from torchfovea.perception import Observer, compiled, decide, new_memory, perceive
from torchfovea.rows import each, to_device
from torchfovea.sensing.triangulation import observe
from torchfovea.sensing.unscented import SigmaPoints

__all__ = ["batched_steps", "paths_of_steps"]


def _known(memory: Memory) -> tuple[Any, ...]:
    """Cells, information and counts in NumPy, in the cells' dtype, the matrices whole."""
    vector, matrix = (part.to(memory.cells.dtype) for part in memory.information)
    parts = (memory.cells, vector, unpack(matrix), memory.bearing)
    return (*(part.cpu().contiguous().numpy() for part in parts), (memory.looks > 0).cpu().numpy())


def _limits(observer: Observer) -> tuple[float, float, float]:
    limits = observer.eligibility
    return limits.nearest_m, limits.ground_z_m, limits.ground_sigmas


def _strategy(look: Saccade) -> Strategy:
    return partial(upper_confidence_bound, alpha=look.alpha)


def _same_choice(what: str, ours: Any, theirs: peers.Choice, share: float) -> None:
    """Rewards and eligibility agree, and our cell is as good as the peer's best."""
    same(what, ours.reward.mean, theirs.rho, 1e-3, share)
    same(what, ours.reward.std, theirs.std, 1e-3, share)
    same(what, ours.eligible.float(), np.isfinite(theirs.score).astype(np.float32), 0, share)
    near = (ours.reward.mean > 0.2).cpu()
    same(what, ours.points.mean.cpu()[near], theirs.points[near.numpy()], 1e-2, share)
    same(what, theirs.score[int(ours.cell)], theirs.score[theirs.cell], 5e-3)


def _decide(look: Saccade) -> Path:
    observer, memory = look.observer, perceive(look.observer, look.memory, look.matches, look.pose)
    prior = (observer.prior.mean, observer.prior.std)
    cells, vector, matrix, bearing, seen = _known(memory)
    limits = _limits(observer)
    choose = partial(decide, observer, strategy=_strategy(look))
    ours = partial(choose, memory)

    def theirs() -> peers.Choice:
        return peers.decide(cells, vector, matrix, bearing, seen, observer.head, prior, limits, look.alpha)

    def check() -> None:
        _same_choice("decide", ours(), theirs(), 0.999)

    sizes = shares(memory.cells.shape[0])

    def part(size: int) -> Any:
        less = each(lambda p: p[:size] if p.dim() == 1 else columns(*p[:size].unbind(-1)), memory, (CellIndex,))
        return partial(choose, less)

    done = ours()
    fast = compiled_peer(
        look.compile, lambda mode: partial(decide, compiled(observer, mode), memory, strategy=_strategy(look))
    )
    return Path(
        "decide",
        f"{len(memory.cells)} cells",
        str(memory.cells.device),
        ours,
        (Peer("NumPy, linalg.inv", theirs), *fast),
        check,
        nbytes(memory, done.points, done.reward, done.eligible),
        (Growth("cells", sizes, tuple(map(part, sizes))),),
    )


def _one_step(look: Saccade) -> Any:
    memory = perceive(look.observer, look.memory, look.matches, look.pose)
    return decide(look.observer, memory, strategy=_strategy(look))


def _compiled_step(look: Saccade, mode: str) -> Callable[[], Any]:
    return partial(_one_step, look._replace(observer=compiled(look.observer, mode)))


def _step(look: Saccade, full: Observer) -> list[Path]:
    observer, memory = look.observer, look.memory
    cells, vector, matrix, bearing, _ = _known(memory)
    px, sigma = (part.cpu().numpy() for part in flat_of(look.matches))
    rig = peers.converted(peers.rig_of(look.pose, observer.camera.focal_px), lambda a: a.astype(px.dtype))
    support = observe(look.matches, look.pose, observer.camera, support_of(look)).support_rad.cpu().numpy()
    gates = (math.radians(observer.fusion.gate_deg), observer.fusion.gate_spacing)
    theirs = partial(
        peers.step, px, sigma, support, look.matches.valid.cpu().numpy(), rig, SigmaPoints(), cKDTree(cells),
        peers.tangent_frames(np, cells), memory.spacing_rad.cpu().numpy(), gates, vector, matrix, bearing,
        observer.prior.slope_std, observer.head, (observer.prior.mean, observer.prior.std), _limits(observer),
        look.alpha,
    )  # fmt: skip
    ours = partial(_one_step, look)

    def check() -> None:
        _same_choice("step", ours(), theirs(), 0.99)

    def check_full() -> None:
        if int(_one_step(whole).cell) < 0:
            raise RuntimeError("step: nothing to fixate")

    done, device = ours(), str(memory.cells.device)
    work = f"{len(px)} RFs to {len(cells)} cells to the next fixation"
    sizes, cell_sizes = shares(len(px)), shares(len(cells))
    by_cells = tuple(
        partial(_one_step, look._replace(memory=to_device(new_memory(observer, memory.cells[:n].cpu()), device)))
        for n in cell_sizes
    )
    growths = (
        Growth("RFs", sizes, tuple(partial(_one_step, part_of(look, n)) for n in sizes)),
        Growth("cells", cell_sizes, by_cells),
    )
    whole = look._replace(observer=full)
    fast, fast_whole = (compiled_peer(one.compile, partial(_compiled_step, one)) for one in (look, whole))
    moved = nbytes(look.matches, memory, done.memory, done.points, done.reward, done.eligible)
    return [
        Path("step", work, device, ours, (Peer("NumPy and SciPy, vectorized", theirs), *fast), check, moved, growths),
        Path(
            "step", work + ", with fill and conflicts", device, partial(_one_step, whole), fast_whole,
            check_full, moved,
        ),
    ]  # fmt: skip


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
        nbytes(together.matches, together.memory, done.memory, done.points, done.reward, done.eligible),
        (Growth("batch", sizes, runs),) if len(sizes) > 1 else (),
        batch,
    )


def paths_of_steps(look: Saccade, full: Observer) -> list[Path]:
    """The decision, the whole step, and the step with all that the observer does.

    Args:
        look: from `torchfovea.commands.bench.look.saccade`, by an observer of patches without fill and conflicts.
        full: the observer with them.
    """
    return [_decide(look), *_step(look, full)]
