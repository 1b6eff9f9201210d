"""`torchfovea search`: visual-search episodes, their figures, tables and a picture (paper Sec. 7.2)."""

from __future__ import annotations

import shutil
import statistics
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from torchfovea.commands.search.figure1 import draw_scene, sensors_of
from torchfovea.commands.search.remembering import (
    Best,
    best_fixation,
    biased,
    check_resample,
    refit,
    rounds,
    write_bias,
)
from torchfovea.commands.shared.build import build_observer, build_route, check_readable
from torchfovea.commands.shared.config import run_folder
from torchfovea.commands.shared.figures import EPISODE_COLUMNS, episode_row
from torchfovea.commands.shared.manifest import complete, finished
from torchfovea.commands.shared.memories import memory_path
from torchfovea.commands.shared.parallel import spread, workers_of
from torchfovea.commands.shared.rehearsal import rehearse
from torchfovea.commands.shared.rollout import batched, episodes_device, kept_scene, one_episode, roll_out
from torchfovea.commands.shared.screen import print_figures, progress_bar
from torchfovea.commands.shared.settings import choice, whole
from torchfovea.commands.shared.viewers import Show, check_viewer, viewers
from torchfovea.episode import Each, Episode
from torchfovea.files import write_csv
from torchfovea.memory.store import save_memory
from torchfovea.metrics import phantom
from torchfovea.perception import Observer
from torchfovea.rows import row
from torchfovea.search import Glance
from torchfovea.sensing.head import Gaze
from torchfovea.setting import require

__all__ = ["SACCADE_COLUMNS", "run", "saccade_rows", "summarize"]

SACCADE_COLUMNS = (
    "episode", "saccade", "pan_rad", "tilt_rad", "vergence_rad", "range_m", "reward", "gap", "regret",
    "global_information", "local_information", "aimed_m", "phantom",
)  # fmt: skip


def run(cfg: DictConfig) -> float:
    """Run the episodes of a configuration; the mean gap per saccade is what a sweeper sees."""
    episodes, saccades, seed = whole(cfg, "episodes"), whole(cfg, "saccades"), whole(cfg, "seed", 0)
    observer = build_observer(cfg)
    choice(cfg, "fidelity", ("photometric", "geometric"))
    if not batched(cfg):
        check_readable(cfg, observer)
    episodes_device(cfg), whole(cfg, "batch"), workers_of(cfg)
    require(not (cfg.record and cfg.fidelity == "geometric"), "record", True, "images, fidelity=photometric")
    watched = check_viewer(cfg)
    alone = not watched or workers_of(cfg)[0] == 1
    require(alone, "workers", cfg.workers, "1 with viewer or video, which follow the last episode")
    rehearse(cfg, observer.head, observer)
    check_resample(cfg, observer)
    saved, both = memory_path(cfg, "memory.save"), sensors_of(cfg, observer)
    folder = run_folder()
    done = finished(cfg, folder)
    if done is not None:
        return done
    rows: list[tuple[Any, ...]] = []
    steps: list[tuple[Any, ...]] = []
    last: Episode | None = None
    with progress_bar() as progress:
        task = progress.add_task("search", total=episodes * saccades)

        def advance(count: int) -> None:
            progress.update(task, advance=count)

        seeds, recordings = [seed + k for k in range(episodes)], _recordings(cfg, folder, episodes)
        with viewers(cfg, folder, observer, "episode") as show:
            shown = show if watched else None
            for k, figures, course, _, episode in _learning(cfg, observer, seeds, advance, recordings, shown, folder):
                last = episode
                rows.append((k, seed + k, *figures))
                steps.extend((k, *line) for line in course)
    write_csv(folder / "episodes.csv", EPISODE_COLUMNS, rows)
    write_csv(folder / "saccades.csv", SACCADE_COLUMNS, steps)
    assert last is not None
    if cfg.picture:
        _draw(folder, cfg, observer, last, rows[-1])
    if both:
        gaze = Gaze(*(angle[-1] for angle in last.gaze))
        draw_scene(folder / "figure1.png", both, seed + episodes - 1, gaze)
    if saved is not None:
        save_memory(saved, last.step.memory)
    summary = summarize(rows)
    complete(folder, summary)
    print_figures(summary)
    return float(summary["gap_per_saccade"])


Outcome = tuple[int, tuple[Any, ...], list[tuple[Any, ...]], Best, Episode | None]


def _recordings(cfg: DictConfig, folder: Path, episodes: int) -> list[str | None]:
    """Where each episode is recorded: in recording, or recording/0, recording/1, ...; None: nowhere."""
    if not cfg.record:
        return [None] * episodes
    whole_run = folder / "recording"
    shutil.rmtree(whole_run, ignore_errors=True)  # of a run that was cut off here
    return [str(whole_run)] if episodes == 1 else [str(whole_run / str(k)) for k in range(episodes)]


def _learning(
    cfg: DictConfig,
    observer: Observer,
    seeds: list[int],
    advance: Callable[[int], None],
    recordings: list[str | None],
    show: Show | None,
    folder: Path,
) -> Iterator[Outcome]:
    """The episodes; with memory.resample in rounds, after each of which the bias is fitted to what it has found."""
    if not check_resample(cfg, observer):
        yield from _episodes(cfg, observer, seeds, range(len(seeds)), advance, recordings, show)
        return
    for part in rounds(len(seeds)):
        found = []
        for outcome in _episodes(cfg, observer, seeds, part, advance, recordings, show):
            found.append(outcome[3])
            yield outcome
        mixture = refit(cfg, found)
        if mixture is not None:
            cfg = biased(cfg, mixture)
            write_bias(folder, mixture)


def _episodes(
    cfg: DictConfig,
    observer: Observer,
    seeds: list[int],
    numbers: range,
    advance: Callable[[int], None],
    recordings: list[str | None],
    show: Show | None,
) -> Iterator[Outcome]:
    """Number, figures, course and best fixation of some episodes in order; of all the last one's episode itself."""
    (workers, backend), final = workers_of(cfg), len(seeds) - 1
    if batched(cfg):
        size = whole(cfg, "batch")
        for start in numbers[::size]:
            part = seeds[start : min(start + size, numbers.stop)]
            last = show if start + len(part) > final else None
            together = roll_out(cfg, observer, part, each=_each(advance, len(part), last))
            yield from (_outcome(k, episode, k == final) for k, episode in enumerate(together, start))
        return
    if workers == 1 or final == 0:
        for k in numbers:
            each = _each(advance, 1, show if k == final else None)
            yield _outcome(k, one_episode(cfg, observer, seeds[k], each, recordings[k]), k == final)
        return
    settings = OmegaConf.to_yaml(OmegaConf.masked_copy(cfg, [str(key) for key in cfg if key != "hydra"]), resolve=True)
    outcomes: dict[int, Outcome] = {}
    work = [(settings, k, seeds[k], k == final, recordings[k]) for k in numbers]
    for _, outcome in spread(_elsewhere, work, workers, backend):
        if isinstance(outcome, Exception):
            raise outcome
        advance(whole(cfg, "saccades"))
        outcomes[outcome[0]] = outcome
    yield from (outcomes[k] for k in numbers)


def _outcome(k: int, episode: Episode, kept: bool) -> Outcome:
    return k, episode_row(episode), saccade_rows(episode), best_fixation(episode), episode if kept else None


def _each(advance: Callable[[int], None], count: int, show: Show | None = None) -> Each:
    """What episodes call after every decision: so many saccades are done, and the last episode's is shown."""

    def each(t: int, glance: Glance) -> None:
        advance(count)
        if show is not None:
            single = glance._replace(step=glance.step._replace(state=None))
            show(t, row(single, len(glance.looked) - 1) if glance.looked.dim() else single)

    return each


def _elsewhere(work: tuple[str, int, int, bool, str | None]) -> Outcome:
    """An episode in a process of its own: its settings, number and seed, whether it comes back whole, its recording."""
    settings, k, seed, kept, record = work
    cfg = OmegaConf.create(settings)
    assert isinstance(cfg, DictConfig)
    return _outcome(k, one_episode(cfg, build_observer(cfg), seed, record=record), kept)


def saccade_rows(episode: Episode) -> list[tuple[Any, ...]]:
    """An episode's course, in the order of SACCADE_COLUMNS from saccade (counted from 1) on."""
    local = episode.local_information
    columns = (*episode.gaze, episode.range_m, episode.reward, episode.gap, episode.regret, episode.global_information)
    aims, nothing = episode.aimed_m, phantom(episode.aimed_m, episode.range_m)
    return [
        (
            t + 1, *(float(c[t]) for c in columns), None if local is None else float(local[t]), float(aims[t]),
            int(nothing[t]),
        )
        for t in range(len(episode.gap))
    ]  # fmt: skip


def summarize(rows: list[tuple[Any, ...]]) -> dict[str, Any]:
    """Means over the episodes; a figure that some episode lacks is averaged over those that have it."""
    figures: dict[str, Any] = {}
    for name, values in zip(EPISODE_COLUMNS[2:], list(zip(*rows, strict=True))[2:], strict=True):
        known = [v for v in values if v is not None]
        figures[name] = statistics.fmean(known) if known else None
    figures["saccades_to_target_median"] = statistics.median(
        row[EPISODE_COLUMNS.index("saccades_to_target")] for row in rows
    )
    figures["episodes"] = len(rows)
    return figures


def _draw(folder: Path, cfg: DictConfig, observer: Observer, episode: Episode, row: tuple[Any, ...]) -> None:
    from torchfovea.commands.search.pictures import draw_episode

    moves = row[EPISODE_COLUMNS.index("saccades_to_target")]
    outcome = (
        f"target fixated after {moves:g} saccade{'s' * (moves != 1)}" if bool(episode.hit.any()) else "target not found"
    )
    scene, sensor = cfg.scene.name.replace("_", " "), cfg.sensor.layout.replace("_", "-")
    title = f"{scene}, {sensor}, {cfg.sensor.fov_deg:g}°: {outcome}"
    seen = kept_scene(cfg, observer.head, row[EPISODE_COLUMNS.index("seed")])
    route = build_route(cfg)
    if route is not None:
        seen = replace(seen, pose=route.pose(episode.looks - 1))
    draw_episode(folder / "episode.png", episode, observer.retina, title, seen)
