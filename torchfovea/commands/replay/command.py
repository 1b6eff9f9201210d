"""`torchfovea replay`: a recording into the memory, frame by frame, the next fixation proposed at each."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any, NamedTuple

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from torchfovea.cloud import carried_colours, cloud_of, painted, unpainted, write_cloud
from torchfovea.commands.shared.build import build_cells, build_match, build_observer
from torchfovea.commands.shared.cameras import OF_FILES, cameras_of_files
from torchfovea.commands.shared.config import run_folder
from torchfovea.commands.shared.memories import loaded_memory, memory_path
from torchfovea.commands.shared.named import name_of
from torchfovea.commands.shared.rehearsal import rehearse
from torchfovea.commands.shared.rollout import sample_of
from torchfovea.commands.shared.screen import print_figures, progress_bar, say
from torchfovea.commands.shared.settings import changed, construct, whole
from torchfovea.commands.shared.strategy import build_strategy
from torchfovea.commands.shared.unread import refuse_unread
from torchfovea.commands.shared.viewers import Show, check_viewer, viewers
from torchfovea.files import write_csv, write_result
from torchfovea.memory.egosphere import Memory
from torchfovea.memory.store import save_memory
from torchfovea.metrics import global_information
from torchfovea.perception import Observer, new_memory
from torchfovea.recordings.bag import Bag, Topics
from torchfovea.recordings.folder import Folder
from torchfovea.recordings.frames import Calibration, Recording
from torchfovea.recordings.playback import Playback, observer_of
from torchfovea.search import Glance, search
from torchfovea.sensing.head import eyes
from torchfovea.setting import SettingError, require
from torchfovea.stereo.external import External
from torchfovea.stereo.matchers import Matcher

__all__ = ["FIXATION_COLUMNS", "Replayed", "run"]

FIXATION_COLUMNS = (
    "frame", "time_s", "pan_rad", "tilt_rad", "vergence_rad", "looked", "cells_seen", "next_pan_rad", "next_tilt_rad",
    "next_vergence_rad", "x_m", "y_m", "z_m", "cpu_seconds", "seconds",
)  # fmt: skip


class Replayed(NamedTuple):
    """A recording as far as it was read.

    Attributes:
        rows: of fixations.csv.
        glance: the last.
        look: the last glance with images; None: there was none.
        colours: of the memory's cells, (Nx, 3).
        stopped: the error that ended it; None: it was read to its end.
    """

    rows: list[tuple[Any, ...]]
    glance: Glance
    look: Glance | None
    colours: Tensor
    stopped: BaseException | None


def run(cfg: DictConfig) -> float | None:
    """Play a recording; the memory's mean information is what a sweeper sees."""
    refuse_unread("sensor.fov_deg", "sensor.camera", "sensor.source_px")
    recording = open_recording(cfg)
    watched = check_viewer(cfg)
    cfg = told_by(cfg, recording.calibration)
    observer = observer_of(build_observer(cfg), recording.calibration)
    rehearse(cfg, observer.head, observer)
    require(cfg.acquisition.name != "oracle", "acquisition", "oracle", "one that does not ask where the target is")
    matcher, strategy, saved = build_match(cfg), build_strategy(cfg, observer), memory_path(cfg, "memory.save")
    ours = isinstance(matcher, Matcher) and not isinstance(matcher.params, External)
    ahead, folder = whole(cfg, "ahead", 0) * ours, run_folder()
    generator = torch.Generator().manual_seed(whole(cfg, "seed", 0))
    memory = loaded_memory(cfg, observer)
    if memory is None:
        memory = new_memory(observer, build_cells(cfg, observer.head, generator))
    passed: list[str] = []

    def pass_over(error: SettingError) -> None:
        passed.append(str(error))
        say(f"replay: passed over: {error}")

    robot = Playback(recording, observer, matcher, sample_of(cfg), pass_over if cfg.skip else None, ahead)
    glances = search(robot, observer, memory, len(recording), generator, strategy)
    with viewers(cfg, folder, observer, "replay") as show:
        done = _play(robot, observer, memory, glances, len(recording), show if watched else None)

    step = done.glance.step
    write_csv(folder / "fixations.csv", FIXATION_COLUMNS, done.rows)
    for path in {str(folder / "memory.npz"), *([] if saved is None else [saved])}:
        save_memory(path, step.memory)
    write_cloud(folder / "points", cloud_of(step.memory, done.colours))
    if cfg.picture:
        from torchfovea.commands.replay.pictures import draw_replay

        draw_replay(folder / "replay.png", done.look, done.glance, done.colours, done.rows, observer.retina)
    figures = figures_of(done, len(passed), ahead)
    write_result(folder, figures)
    print_figures(figures)
    if done.stopped is not None:
        raise done.stopped
    return float(figures["information"])


def open_recording(cfg: DictConfig) -> Recording:
    """The recording of a configuration: a folder of its own form, or a bag."""
    expected = "a recording's folder (docs/recordings.md) or a ROS 2 bag"
    require(cfg.recording is not None, "recording", None, expected)
    path = Path(cfg.recording)
    require(path.exists(), "recording", path, f"{expected}, but there is nothing")
    topics = construct(Topics, cfg.bag, "bag")
    if path.is_dir() and not (path / "metadata.yaml").exists():
        refuse_unread("bag.*")
        if cfg.calibration is None:
            refuse_unread("calibration_images", *OF_FILES)
            return Folder(path)
        return Folder(path, lambda size: cameras_of_files(cfg, size)[:2])
    refuse_unread("calibration", "calibration_images", *OF_FILES)
    return Bag(path, topics)


def told_by(cfg: DictConfig, calibration: Calibration) -> DictConfig:
    """The settings with what the recording tells: the head, the field of view and the images' size."""
    size = min(calibration.size_px)
    edge = torch.tensor([calibration.left.cx_px + size / 2, calibration.left.cy_px], dtype=torch.float64)
    x, y, z = calibration.left.rays(edge).unbind(-1)
    fov_deg = 2 * math.degrees(float(torch.atan2(torch.hypot(x, y), z)))
    kind = "pinhole" if fov_deg < 179 else "fisheye"  # of `sensor`, whose camera the recording's takes the place of
    told: dict[str, Any] = {"sensor": {"source_px": size, "fov_deg": fov_deg, "camera": kind}}
    if calibration.rendered:
        told["fidelity"] = "photometric"
    if OmegaConf.select(cfg, "head") is None:
        expected = "vizzy, human, ... : the recording does not tell its head"
        require(calibration.head is not None, "head", None, expected)
        told["head"] = vars(calibration.head)
    OmegaConf.set_struct(cfg, False)
    cfg = changed(cfg, told)
    name_of(cfg, "sensor", "layout")
    return cfg


def _play(robot: Playback, observer: Observer, memory: Memory, glances: Any, count: int, show: Show | None) -> Replayed:
    """All frames, or those before the first that cannot be used.

    Raises:
        SettingError: if that is the first frame.
    """
    rows: list[tuple[Any, ...]] = []
    last: Glance | None = None
    look: Glance | None = None
    stopped: BaseException | None = None
    colours = unpainted(memory)
    with progress_bar() as progress:
        task = progress.add_task("replay", total=count)
        start, since = time.process_time(), time.perf_counter()
        try:
            for glance in glances:
                colours = _colours(robot, observer, memory, colours, glance)
                memory, last, look = glance.step.memory, glance, look if glance.look is None else glance
                rows.append(_row(robot, glance, len(rows), time.process_time() - start, time.perf_counter() - since))
                if show is not None:
                    show(len(rows) - 1, glance)
                progress.update(task, advance=1)
                start, since = time.process_time(), time.perf_counter()
        except (SettingError, KeyboardInterrupt) as error:
            if last is None:
                raise
            stopped = error
    assert last is not None
    return Replayed(rows, last, look, colours, stopped)


def _colours(robot: Playback, observer: Observer, before: Memory, colours: Tensor, glance: Glance) -> Tensor:
    """Of the memory's cells, after a glance."""
    after = glance.step.memory
    if glance.move.base is not None:
        colours = carried_colours(colours, before, after, glance.move.base)
    if glance.look is None:
        return colours
    pose = eyes(observer.head, glance.move.gaze)
    camera, image = robot.calibration.left, glance.look.pictures.left
    looked = (after.looks > 0) & (after.looks != before.looks) if glance.move.base is None else after.looks > 0
    return painted(colours, looked, glance.step.points.mean, image, camera, pose)


def _row(robot: Playback, glance: Glance, number: int, *seconds: float) -> tuple[Any, ...]:
    assert robot.moment is not None
    step, cell = glance.step, int(glance.step.cell)
    point = step.points.mean[cell].tolist() if cell >= 0 else [None] * 3
    angles = [*map(float, glance.move.gaze)], [*map(float, step.gaze)]
    looked = int(glance.look is not None)
    seen = int((step.memory.looks > 0).sum())
    return (number, robot.moment.time_s, *angles[0], looked, seen, *angles[1], *point, *seconds)


def figures_of(done: Replayed, passed: int, ahead: int) -> dict[str, Any]:
    """What a replay comes to."""
    # the first frame warms up, and in the last ones nothing is left to be matched ahead
    step, later = done.glance.step, done.rows[1 : len(done.rows) - ahead] or done.rows
    cpu, seconds = (sum(row[FIXATION_COLUMNS.index(name)] for row in later) for name in ("cpu_seconds", "seconds"))
    return {
        "frames": len(done.rows),
        "frames_with_images": sum(row[FIXATION_COLUMNS.index("looked")] for row in done.rows),
        "frames_passed_over": passed,
        "cells_seen": int((step.memory.looks > 0).sum()),
        "information": float(global_information(step.points.cov)),
        "cpu_seconds_per_frame": cpu / len(later),
        "frames_per_cpu_second": len(later) / max(cpu, 1e-9),
        "frames_per_second": len(later) / max(seconds, 1e-9),
        "stopped": None if done.stopped is None else str(done.stopped) or "interrupted",
    }
