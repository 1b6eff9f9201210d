"""The commands: what each is for, how it is called, where its function lies."""

from __future__ import annotations

from typing import NamedTuple

__all__ = ["COMMANDS", "Command"]


class Command(NamedTuple):
    """A command: where its function lies (imported only when chosen), and its lines in the help.

    Attributes:
        target: module:function, of the composed configuration.
        summary: what it is for.
        examples: the first is the one to begin with.
        resumes: whether a run goes on if its folder is given again.
        draws: whether it ends in a picture, so that matplotlib is asked for first.
    """

    target: str
    summary: str
    examples: tuple[str, ...]
    resumes: bool = False
    draws: bool = False


# A command NAME is a function of its composed configuration conf/NAME.yaml; what it returns is the score that
# Hydra's sweepers see.
COMMANDS: dict[str, Command] = {
    "search": Command(
        "torchfovea.commands.search.command:run",
        "find the nearest object by saccades, and map the scene: the main job",
        (
            "torchfovea search scene=cans",
            "torchfovea search scene=cans scene.outside_first_view=true sensor.fov_deg=90 saccades=20",
            "torchfovea search fidelity=geometric acquisition.alpha=0,1,2 --multirun",
        ),
        resumes=True,
        draws=True,
    ),
    "sense": Command(
        "torchfovea.commands.sense.command:run",
        "a stereo pair in, 3-D points with covariances out",
        (
            "torchfovea sense pair=motorcycle",
            "torchfovea sense left=left.png right=right.png calibration=stereo.yml",
            "torchfovea sense pair=motorcycle matcher=sgbm sensor=uniform",
        ),
        draws=True,
    ),
    "replay": Command(
        "torchfovea.commands.replay.command:run",
        "a recording into the memory, the next fixation proposed at each frame",
        (
            "torchfovea replay recording=outputs/search/NAME/recording",
            "torchfovea replay recording=FOLDER acquisition=ei skip=true",
            "torchfovea replay recording=BAG head=vizzy bag.left=/left/image_rect bag.right=/right/image_rect",
        ),
        draws=True,
    ),
    "characterize": Command(
        "torchfovea.commands.characterize.command:run",
        "what two eyes know of planes, foveal and uniform (Fig. 5), and how far to believe it",
        (
            "torchfovea characterize profile=quick",
            "torchfovea characterize sensor.fov_deg=60 realised.run=false",
            "torchfovea characterize experiment=fig5 --multirun",
        ),
        resumes=True,
        draws=True,
    ),
    "tune": Command(
        "torchfovea.commands.tune.command:run",
        "learn the memory's bias and alpha by gradient on simulated episodes",
        (
            "torchfovea tune profile=quick distribution=left_below",
            "torchfovea tune tune_fov=true prior_field=false",
            "torchfovea tune study=curves seeds=2 methods=[covered,cma_es]",
        ),
        resumes=True,
        draws=True,
    ),
    "reproduce": Command(
        "torchfovea.commands.reproduce.command:run",
        "the paper's figures and claims, measured again, with intervals and verdicts",
        (
            "torchfovea reproduce profile=quick",
            "torchfovea reproduce profile=reduced ablation=true workers=2",
            "torchfovea reproduce profile=reduced hydra.run.dir=FOLDER",
        ),
        resumes=True,
        draws=True,
    ),
    "collect": Command(
        "torchfovea.commands.collect:run",
        "a sweep's results in one table",
        (
            "torchfovea collect dir=multirun/search/study",
            "torchfovea collect dir=multirun/fig8",
            "torchfovea collect dir=multirun",
        ),
    ),
    "calibrate": Command(
        "torchfovea.commands.calibrate.command:run",
        "is the claimed uncertainty true? fit the error budget and judge it",
        (
            "torchfovea calibrate real=true",
            "torchfovea calibrate profile=quick matcher=sweep sensor=uniform",
            "torchfovea calibrate scenes=0 pairs=[motorcycle,FOLDER]",
        ),
        draws=True,
    ),
    "memory": Command(
        "torchfovea.commands.memory.command:run",
        "draw and describe a memory's bias, or study how the memory fuses, moves and is drawn anew",
        (
            "torchfovea memory memory=target",
            "torchfovea memory memory=equator memory.cells=5000",
            "torchfovea memory study=honesty scene=cans",
        ),
    ),
    "bench": Command(
        "torchfovea.commands.bench.command:run",
        "how long the hot paths take, beside the peers that one would pick",
        (
            "torchfovea bench profile=quick",
            "torchfovea bench profile=quick threads=1",
            "torchfovea bench",
        ),
    ),
    "benchmark": Command(
        "torchfovea.commands.benchmark.command:run",
        "policies, matchers, memories and whole systems on the same scenes, and a leaderboard",
        (
            "torchfovea benchmark profile=quick",
            "torchfovea benchmark profile=reduced tracks=[policy] workers=2",
            "torchfovea benchmark report=[run_1,run_2]",
        ),
        resumes=True,
    ),
    "doctor": Command(
        "torchfovea.commands.doctor:run",
        "what this machine has and can render, and what to install for the rest",
        (
            "torchfovea doctor",
            "torchfovea doctor save=true",
            "torchfovea doctor probe_timeout_s=120",
        ),
    ),
}
