"""From a composed configuration to the library's dataclasses, each value checked under the name the user knows."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from torchfovea.commands.shared.budgets import build_budget
from torchfovea.commands.shared.named import build_named, name_of, targets_of
from torchfovea.commands.shared.rewards import build_classes, build_reward
from torchfovea.commands.shared.settings import changed, choice, construct, number, plain, whole
from torchfovea.imported import load_function, made_if_class, require_takes
from torchfovea.memory import sphere
from torchfovea.memory.egosphere import Fusion, Prior
from torchfovea.perception import Eligibility, Observer
from torchfovea.sensing.camera import Camera, Fisheye, Pinhole
from torchfovea.sensing.head import Head, Kinematics, fixate
from torchfovea.sensing.layout import Retina
from torchfovea.sensing.own_layout import check_retina
from torchfovea.sensing.unscented import SigmaPoints
from torchfovea.setting import SettingError, require, typed
from torchfovea.sim.arena import SimulatedArena
from torchfovea.sim.marked import check_marks
from torchfovea.sim.motor import Motor
from torchfovea.sim.noise import ImageNoise
from torchfovea.sim.rays import Renderer
from torchfovea.sim.scene import Room, Scene, build_scene
from torchfovea.sim.walk import Route
from torchfovea.sim.world import World
from torchfovea.stereo.external import External, resolve_source
from torchfovea.stereo.matchers import Match, Matcher
from torchfovea.stereo.sgbm import SGBM
from torchfovea.stereo.sweep import Sweep

__all__ = [
    "build_arena",
    "build_camera",
    "build_cells",
    "build_head",
    "build_match",
    "build_matcher",
    "build_motor",
    "build_noise",
    "build_observer",
    "build_renderer",
    "build_route",
    "build_scene_of",
    "build_sensor",
    "check_readable",
]

# settings of the group sensor that are not the layout's own
SENSOR = ("layout", "camera", "fov_deg", "sample", "source_px")
# settings of the group matcher that are not a built-in matcher's own parameters
MATCHER = ("name", "nearest_range_m", "source", "model")

# A direction counts as reachable if its point at this range is: the neck turns about E, the eyes sit beside it.
REACH_RANGE_M = 1.0


def build_sensor(cfg: DictConfig) -> tuple[Camera, Retina]:
    """The eyes' camera, in retinal pixels, and their retina."""
    every = name_of(cfg, "sensor", "layout") == "every_pixel"
    require(not every, "sensor.layout", "every_pixel", "a retina; every pixel is for sense alone")
    made = build_named(cfg, "sensor", "a layout of receptive fields", SENSOR, "layout", ())
    # what a source names may be a function that makes the layout
    maker = callable(made) and not hasattr(made, "centers_px")
    retina = check_retina(made() if maker else made, "sensor")
    return build_camera(cfg, retina.radius_px), retina


def build_camera(cfg: DictConfig, radius_px: float) -> Camera:
    """The eyes' camera, in pixels of a retina of a radius."""
    kind = choice(cfg, "sensor.camera", ("pinhole", "fisheye"))
    fov_deg = typed(cfg.sensor.fov_deg, "float", "sensor.fov_deg")
    widest = 180 if kind == "pinhole" else 360
    require(0 < fov_deg < widest, "sensor.fov_deg", fov_deg, f"more than 0 and less than {widest} for a {kind} camera")
    require(fov_deg >= 1e-3, "sensor.fov_deg", fov_deg, "at least 0.001 degrees")
    return (Pinhole if kind == "pinhole" else Fisheye).from_fov(fov_deg, radius_px)


def build_observer(cfg: DictConfig) -> Observer:
    """The observer that a configuration describes; its strategy is `torchfovea.commands.shared.strategy`'s to build."""
    camera, retina = build_sensor(cfg)
    budget = build_budget(cfg)
    printed = choice(cfg, "budget.sigma_points", ("ours", "paper")) == "paper"
    return Observer(
        head=build_head(cfg),
        camera=camera,
        retina=retina,
        budget=budget,
        points=SigmaPoints.paper() if printed else None,
        rotated=not printed,
        fusion=construct(Fusion, cfg.fusion, "fusion"),
        prior=construct(Prior, cfg.prior, "prior"),
        reward=build_reward(cfg),
        eligibility=construct(Eligibility, cfg.eligibility, "eligibility"),
        compile=str(OmegaConf.select(cfg, "compile", default="off")),
        classes=build_classes(cfg),
    )


def build_head(cfg: DictConfig) -> Any:
    """The head: a `Head`, or a user's own kinematics by ``source=package.module:function``."""
    if "source" not in cfg.head:
        return construct(Head, cfg.head, "head")
    form = "package.module:function, a function without arguments that returns a torchfovea.sensing.head.Kinematics"
    require(cfg.head.source is not None, "head.source", None, form)
    maker = load_function(cfg.head.source, "head.source")
    require_takes(maker, (), "head.source", cfg.head.source)
    head = maker()
    require(isinstance(head, Head | Kinematics), "head", type(head).__name__, form)
    return head


def build_cells(cfg: DictConfig, head: Head, generator: torch.Generator, dtype: torch.dtype = torch.float32) -> Tensor:
    """The memory's directions, restricted to what the head can fixate, (cells, 3).

    Raises:
        SettingError: for no cells, a bad mixture or one that never falls within reach.
    """
    count = whole(cfg, "memory.cells")
    memory = plain(cfg.memory)

    def reachable(directions: Tensor) -> Tensor:
        return fixate(head, REACH_RANGE_M * directions)[1]

    if memory.get("topology"):
        topologies = {
            "latitude_longitude": sphere.latitude_longitude_directions,
            "geodesic": sphere.geodesic_directions,
            "truncated_icosahedron": sphere.truncated_icosahedron_directions,
            "fibonacci": sphere.fibonacci_directions,
        }
        name = memory["topology"]
        require(name in topologies, "memory.topology", name, "one of " + ", ".join(topologies))
        return sphere.reachable_directions(topologies[name], count, reachable).to(dtype)
    missing = [key for key in ("weights", "means", "covariances") if key not in memory]
    if missing:
        raise SettingError(f"memory.{missing[0]} = missing: expected a mixture's weights, means and covariances")
    mixture = sphere.direction_mixture(memory["weights"], memory["means"], memory["covariances"], dtype=torch.float64)
    return sphere.sample(mixture, count, generator, reachable).to(dtype)


def build_scene_of(cfg: DictConfig, head: Head, seed: int) -> Scene:
    """The scene of a configuration's group `scene`."""
    known = isinstance(head, Head)
    require(known, "head", type(head).__name__, "one that the simulator knows; yours is for `replay` and a robot")
    name_of(cfg, "scene")
    if "room" in cfg.scene and "_target_" not in cfg.scene.room:  # as scene files were before _target_
        cfg = changed(cfg, {"scene": {"room": {"_target_": f"{Room.__module__}.{Room.__name__}"}}})
    form = "a function (seed, head) that returns a Scene"
    return build_scene(build_named(cfg, "scene", form, takes=("seed", "head")), seed, head)


def build_renderer(cfg: DictConfig) -> Renderer:
    """What draws the pictures."""
    name_of(cfg, "renderer")
    form = "a function (scene, R, t, camera, size_px) that returns a Frame"
    renderer: Renderer = build_named(cfg, "renderer", form, takes=("scene", "R", "t", "camera", "size_px"))
    require(callable(renderer), "renderer", type(renderer).__name__, form)
    return renderer


def build_noise(cfg: DictConfig) -> ImageNoise | None:
    """What the rendered pictures suffer from; None where a configuration asks for none."""
    node = OmegaConf.select(cfg, "noise")
    if node is None:
        return None
    require(isinstance(node, DictConfig), "noise", node, "photons, read and exposure; null: none")
    return construct(ImageNoise, node, "noise")


def build_motor(cfg: DictConfig) -> Callable[[Scene], Motor]:
    """What turns the head of a scene."""
    name_of(cfg, "motor")
    form = "a motor that has move(head, before, command), or a function of the scene's MuJoCo model that returns one"
    made = build_named(cfg, "motor", form)
    moves = callable(getattr(made, "move", None)) and not isinstance(made, type)
    require(moves or callable(made), "motor", type(made).__name__, form)
    if not moves:
        require_takes(made, ("model",), "motor", cfg.motor.get("source") or cfg.motor.name)

    def motor_of(scene: Scene) -> Motor:
        motor: Motor = made if moves else made(scene.model)
        require(callable(getattr(motor, "move", None)), "motor", type(motor).__name__, form)
        return motor

    return motor_of


def build_arena(cfg: DictConfig, observer: Observer, seed: int) -> SimulatedArena:
    """The simulated world of an episode."""
    check_readable(cfg, observer)
    scene = build_scene_of(cfg, observer.head, seed)
    if observer.classes is not None:
        check_marks(scene, observer.classes)
    fidelity = choice(cfg, "fidelity", ("photometric", "geometric"))
    world = World(
        scene,
        renderer=build_renderer(cfg),
        motor=build_motor(cfg)(scene),
        camera=observer.camera,
        source_px=whole(cfg, "sensor.source_px", 16),
        radius_px=observer.retina.radius_px,
        noise=build_noise(cfg),
        seed=seed,
    )
    match = build_match(cfg, observer)  # checked even where it is not used
    sample = None if OmegaConf.select(cfg, "sensor.sample") is None else whole(cfg, "sensor.sample", 16)
    geometric, route = fidelity == "geometric", build_route(cfg)
    return SimulatedArena(world, observer, None if geometric else match, sample, seed, route)


def check_readable(cfg: DictConfig, observer: Observer) -> None:
    """Refuse a search for a class that one world's sensor cannot tell; those of many rows read marks themselves.

    Raises:
        SettingError: for pictures that nothing reads, for none, and for a base that moves.
    """
    seen = choice(cfg, "fidelity", ("photometric", "geometric")) == "photometric" and build_route(cfg) is None
    reads = observer.classes is None or (seen and observer.classes.evidence is not None)
    geometric = "motion=still and fidelity=geometric motor=instant in search"
    expected = f"{geometric}, or pictures and reward.evidence, as family=marked_images has"
    require(reads, "reward", "of_class", expected)


def build_route(cfg: DictConfig) -> Route | None:
    """Where the base goes; None: it stands still."""
    if "motion" not in cfg or name_of(cfg, "motion") == "still":
        return None
    route: Route = build_named(cfg, "motion", "a torchfovea.sim.walk.Route", ("name",))
    require(isinstance(route, Route), "motion", type(route).__name__, "a torchfovea.sim.walk.Route")
    return route


def build_match(cfg: DictConfig, observer: Observer | None = None) -> Match:
    """The stereo matcher, built in or a user's own.

    Args:
        cfg: with the group matcher.
        observer: whose memory the matcher may ask; None: there is none.
    """
    name_of(cfg, "matcher")
    form = "a function (views, retina, budget) that returns (Correspondences, found)"
    target = OmegaConf.select(cfg, "matcher._target_") or targets_of("matcher", "name").get(cfg.matcher.name)
    ours = isinstance(target, str) and target.startswith("torchfovea.")
    made = build_named(cfg, "matcher", form, MATCHER if ours else ("name",), takes=("views", "retina", "budget"))
    if isinstance(made, SGBM | Sweep | External):
        source = cfg.matcher.get("source")
        if isinstance(source, DictConfig):
            source = build_named(cfg, "matcher.source", "a function (left, right) that returns a disparity", ())
            require(callable(source), "matcher.source", type(source).__name__, "a function (left, right)")
        if isinstance(made, External):  # whoever has a memory has two eyes, and no rectified pair
            source = made_if_class(resolve_source(source, files=observer is None))
            if callable(source):
                require_takes(source, ("left", "right"), "matcher.source", cfg.matcher.source)
        matcher = Matcher(made, number(cfg, "matcher.nearest_range_m"), source)
        knows = observer is not None and observer.fusion.votes
        expected = "all, or search with fusion=inverse_range, whose memory tells where to look"
        require(knows or not matcher.asks, "matcher.volume", "memory", expected)
        return matcher
    require(callable(made), "matcher", type(made).__name__, form)
    match: Match = made
    return match


def build_matcher(cfg: DictConfig) -> Matcher:
    """The stereo matcher, where it must be a built-in one, whose clues are known.

    Raises:
        SettingError: for a user's own whole matcher.
    """
    matcher = build_match(cfg)
    expected = "sgbm, sweep or external; one of your own matches in search and sense"
    require(isinstance(matcher, Matcher), "matcher", OmegaConf.select(cfg, "matcher.name"), expected)
    assert isinstance(matcher, Matcher)
    return matcher
