"""Where B searches take place, row by row: simulated scenes of three fidelities, or robots."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import torch
from omegaconf import DictConfig
from torch import Tensor

from torchfovea.arena import Arena, Arenas, Fixation, Truth
from torchfovea.commands.shared.build import build_arena, build_motor
from torchfovea.commands.shared.rollout import kept_scene, sample_of
from torchfovea.gaussian import Information, columns
from torchfovea.memory.egosphere import Memory
from torchfovea.perception import Observer, perceive
from torchfovea.search import Look, Move, Robot
from torchfovea.sensing.head import Gaze, eyes
from torchfovea.setting import require
from torchfovea.sim.arena import look_together
from torchfovea.sim.arenas import GeometricArenas
from torchfovea.sim.model import Scene
from torchfovea.sim.truth import truth_of
from torchfovea.tuning.worlds import check_observer, glance

__all__ = ["CellPlaces", "GeometricPlaces", "PhotometricPlaces", "RobotPlaces", "SearchPlaces"]

Generators = Sequence[torch.Generator]


class SearchPlaces(Protocol):
    """B places, of which some rows (K,) are asked at a time."""

    def renew(self, rows: Sequence[int], scenes: Sequence[int], seeds: Sequence[int]) -> None:
        """Put rows into the scenes of some seeds; `seeds` are those of their encoders' noise."""
        ...

    def truth(self, row: int) -> Truth | None:
        """What a judge knows of a row; None: nobody does."""
        ...

    def saccade(self, rows: Sequence[int], gaze: Gaze) -> Move:
        """Turn some heads."""
        ...

    def fixation(self, rows: Sequence[int], gaze: Gaze) -> Fixation | None:
        """The truth at some gazes."""
        ...

    def sense(
        self, rows: Sequence[int], memory: Memory, gaze: Gaze, generators: Generators
    ) -> tuple[Memory, Look | None]:
        """Look, and remember what was seen; the looks themselves where the fidelity has any."""
        ...


class _Scenes:
    """Scenes by their seeds with the truth about them, built when first asked for."""

    def __init__(self, cfg: DictConfig, observer: Observer, cells: Tensor) -> None:
        self.cfg, self.observer, self.cells = cfg, observer, cells
        self.known: dict[int, tuple[Scene, Truth]] = {}

    def __call__(self, seed: int) -> tuple[Scene, Truth]:
        if seed not in self.known:
            scene = kept_scene(self.cfg, self.observer.head, seed)
            truth = truth_of(scene, self.cells)
            near = truth.nearest_m < float(self.cfg.far_m)
            require(near, "far_m", self.cfg.far_m, f"more than the nearest range of scene {seed}, {truth.nearest_m}")
            self.known[seed] = scene, truth
        return self.known[seed]


class GeometricPlaces:
    """Scenes sensed together by the geometric sensor, see `torchfovea.sim.arenas.GeometricArenas`.

    Args:
        cfg: of a search.
        observer: of that search.
        cells: of the memories, (Nx, 3).
        count: B.
        first: the seed of any scene, where rows stand before their first episode.
    """

    def __init__(self, cfg: DictConfig, observer: Observer, cells: Tensor, count: int, first: int) -> None:
        self.observer, self.scenes, self.stands = observer, _Scenes(cfg, observer, cells.cpu()), [first] * count
        scene = self.scenes(first)[0]
        motor, device = build_motor(cfg)(scene), cells.device
        self.arenas = GeometricArenas([scene] * count, observer, sample_of(cfg), device, motor)

    def renew(self, rows: Sequence[int], scenes: Sequence[int], seeds: Sequence[int]) -> None:
        """See `SearchPlaces`."""
        for row, scene in zip(rows, scenes, strict=True):
            self.stands[row] = scene
        self.arenas.renew(rows, [self.scenes(scene)[0] for scene in scenes], seeds)

    def truth(self, row: int) -> Truth:
        """See `SearchPlaces`."""
        return self.scenes(self.stands[row])[1]

    def saccade(self, rows: Sequence[int], gaze: Gaze) -> Move:
        """See `SearchPlaces`."""
        return self.arenas.some(rows).saccade(gaze)

    def fixation(self, rows: Sequence[int], gaze: Gaze) -> Fixation:
        """See `SearchPlaces`."""
        return self.arenas.some(rows).fixation(gaze)

    def sense(
        self, rows: Sequence[int], memory: Memory, gaze: Gaze, generators: Generators
    ) -> tuple[Memory, Look | None]:
        """See `SearchPlaces`."""
        look = self.arenas.some(rows).look(gaze, generators)
        return perceive(self.observer, memory, look.matches, eyes(self.observer.head, gaze)), look


class CellPlaces(GeometricPlaces):
    """The same scenes, sensed cell by cell: one noisy inverse range of each cell that both retinas see.

    Against the geometric sensor nothing hides anything from an eye, and a cell is a direction rather than a patch; the
    standard deviation is that of `torchfovea.tuning.worlds.glance`.
    """

    def __init__(self, cfg: DictConfig, observer: Observer, cells: Tensor, count: int, first: int) -> None:
        check_observer(observer)
        super().__init__(cfg, observer, cells, count, first)
        self.range_m = self._ranges(0).repeat(count, 1)

    def _ranges(self, row: int) -> Tensor:
        own: Tensor = self.truth(row).cell_points.norm(dim=-1)
        return own.to(self.scenes.cells.dtype).clamp(max=1e3).to(self.arenas.kind.device)

    def renew(self, rows: Sequence[int], scenes: Sequence[int], seeds: Sequence[int]) -> None:
        """See `SearchPlaces`."""
        super().renew(rows, scenes, seeds)
        for row in rows:
            self.range_m[row] = self._ranges(row)

    def sense(
        self, rows: Sequence[int], memory: Memory, gaze: Gaze, generators: Generators
    ) -> tuple[Memory, Look | None]:
        """See `SearchPlaces`."""
        pose, range_m = eyes(self.observer.head, gaze), self.range_m[list(rows)]
        visible, variance = glance(self.observer, pose, memory.cells, range_m)
        noise = torch.stack([torch.randn(range_m.shape[1:], generator=g, dtype=range_m.dtype) for g in generators])
        measured = 1 / range_m + variance.sqrt() * noise.to(range_m)
        weight, zero = visible / variance, torch.zeros_like(range_m)
        vector, matrix = memory.information
        known = Information(
            vector + columns(zero, zero, weight * measured), matrix + columns(zero, zero, zero, zero, zero, weight)
        )
        # the place across the line of sight is the cell's own, known to half the way to its neighbours
        bearing = memory.bearing + visible * (2 / memory.spacing_rad).square()
        votes = memory.votes + columns(visible.to(zero), zero)
        after = memory._replace(information=known, bearing=bearing, looks=memory.looks + visible, votes=votes)
        return after._replace(axis=pose.R_left[..., 2]), None


class RobotPlaces:
    """Robots, one a row, that stand where they stand: `torchfovea.search.Robot`s, and judged where they are `Arena`s.

    Args:
        robots: B of them; one that has `fixation` and `truth(cells)` is judged, as simulated arenas are.
        observer: the fixed parts.
        cells: of the memories, (Nx, 3).
    """

    def __init__(self, robots: Sequence[Robot], observer: Observer, cells: Tensor) -> None:
        self.robots: list[Any] = list(robots)
        self.observer, self.cells = observer, cells
        self._truths: dict[int, Truth | None] = {}

    def renew(self, rows: Sequence[int], scenes: Sequence[int], seeds: Sequence[int]) -> None:
        """A robot may have a `reset(seed)` of its own."""
        for row, seed in zip(rows, seeds, strict=True):
            reset = getattr(self.robots[row], "reset", None)
            if callable(reset):
                reset(seed)
            self._truths.pop(row, None)

    def truth(self, row: int) -> Truth | None:
        """See `SearchPlaces`."""
        if row not in self._truths:
            told = getattr(self.robots[row], "truth", None)
            self._truths[row] = told(self.cells.cpu()) if callable(told) else None
        return self._truths[row]

    def _some(self, rows: Sequence[int]) -> Arenas:
        robots: list[Arena] = [self.robots[row] for row in rows]
        return Arenas(robots)

    def saccade(self, rows: Sequence[int], gaze: Gaze) -> Move:
        """See `SearchPlaces`."""
        return self._some(rows).saccade(gaze)

    def fixation(self, rows: Sequence[int], gaze: Gaze) -> Fixation | None:
        """See `SearchPlaces`."""
        if any(self.truth(row) is None for row in rows):
            return None
        return self._some(rows).fixation(gaze)

    def sense(
        self, rows: Sequence[int], memory: Memory, gaze: Gaze, generators: Generators
    ) -> tuple[Memory, Look | None]:
        """See `SearchPlaces`."""
        self._some(rows).expect(memory)
        look = self._look(rows, gaze, generators)
        return perceive(self.observer, memory, look.matches, eyes(self.observer.head, gaze)), look

    def _look(self, rows: Sequence[int], gaze: Gaze, generators: Generators) -> Look:
        return self._some(rows).look(gaze, generators)


class PhotometricPlaces(RobotPlaces):
    """Scenes rendered for both eyes of all rows together; the sweep matches them together, others one by one.

    Args:
        cfg: of a photometric search.
        observer: of that search.
        cells: of the memories, (Nx, 3).
        count: B.
        first: the seed of any scene, where rows stand before their first episode.
    """

    def __init__(self, cfg: DictConfig, observer: Observer, cells: Tensor, count: int, first: int) -> None:
        self.cfg = cfg
        super().__init__([build_arena(cfg, observer, first)] * count, observer, cells)

    def renew(self, rows: Sequence[int], scenes: Sequence[int], seeds: Sequence[int]) -> None:
        """See `SearchPlaces`."""
        for row, scene, seed in zip(rows, scenes, seeds, strict=True):
            arena = build_arena(self.cfg, self.observer, scene)
            arena.noise.manual_seed(seed)
            self.robots[row] = arena
            self._truths.pop(row, None)

    def _look(self, rows: Sequence[int], gaze: Gaze, generators: Generators) -> Look:
        return look_together([self.robots[row] for row in rows], gaze, generators)
