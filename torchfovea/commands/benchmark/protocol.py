"""The protocol: which scenes, seeds and sizes, and what is judged. Frozen; whoever changes it raises `VERSION`."""

from __future__ import annotations

import hashlib
import json
from typing import Any, NamedTuple

from omegaconf import OmegaConf

from torchfovea.commands.shared.composed import compose_search
from torchfovea.setting import require

__all__ = ["FAMILIES", "LEADING", "MARKS", "SIZES", "SPLITS", "TRACKS", "VERSION", "Size", "fingerprint", "seeds_of"]

VERSION = "1"
TRACKS = ("policy", "matcher", "memory", "whole")

# what a family is, as settings of `torchfovea search`
FAMILIES: dict[str, tuple[str, ...]] = {
    "open": ("scene=cans", "scene.outside_first_view=true", "sensor.fov_deg=90"),
    "narrow": ("family=narrow",),
    # the targets anywhere, as the family had them when the protocol was frozen
    "small": (
        "family=small", "scene.target_azimuth_deg=[-65.0,65.0]", "scene.target_elevation_deg=[-40.0,40.0]",
        "scene.outside_first_view=true",
    ),
    "far": ("family=far",),
    "twins": ("family=twins",),
}  # fmt: skip

# first seed and number of scenes in each family; training is anybody's, validation chooses, test is reported
SPLITS = {"training": (10_000, 1024), "validation": (20_000, 64), "test": (30_000, 64)}

MARKS = (1, 5, 10, 20)  # looks after which a memory is judged


class Size(NamedTuple):
    """How much of the protocol a profile runs.

    Attributes:
        families: of FAMILIES, of the policy track; the images' tracks leave out `twins`, whose pictures are large.
        scenes: of each family, the first ones of the split, by track.
        saccades: of an episode, by track policy and whole; of the memory track the last of its marks.
        fields: receptive fields that a geometric look goes through.
        cells: of the memory.
        source_px: of the images.
        image_fields: receptive fields of the retinas that look at images.
        marks: looks after which a memory is judged.
    """

    families: tuple[str, ...]
    scenes: dict[str, int]
    saccades: dict[str, int]
    fields: int
    cells: int
    source_px: int
    image_fields: int
    marks: tuple[int, ...]


SIZES = {
    "paper": Size(
        tuple(FAMILIES), {"policy": 64, "matcher": 32, "memory": 32, "whole": 16}, {"policy": 21, "whole": 11},
        8000, 2000, 400, 31416, MARKS,
    ),
    "reduced": Size(
        tuple(FAMILIES), {"policy": 16, "matcher": 8, "memory": 8, "whole": 4}, {"policy": 11, "whole": 6},
        4000, 2000, 400, 8000, MARKS,
    ),
    "quick": Size(
        ("open", "narrow"), {"policy": 4, "matcher": 2, "memory": 2, "whole": 2}, {"policy": 8, "whole": 3},
        1000, 400, 200, 2000, MARKS[:2],
    ),
}  # fmt: skip

# what the leaderboard shows of a track, best first by the first; −: less is better
LEADING = {
    "policy": ("gap_per_saccade", "found", "gap_final", "-saccades_to_target", "-target_error_m", "-degrees_travelled"),
    "matcher": (
        "-nll", "-median_error", "coverage_50", "coverage_95", "-sharpness", "valid_share", "valid_area",
        "-outlier_share",
    ),
    "memory": ("-nll", "-median_error", "nees_mean", "coverage_50", "coverage_95", "-sharpness", "known_share"),
    "whole": ("gap_per_saccade", "found", "gap_final", "-phantom_share", "-target_error_m", "-degrees_travelled"),
}  # fmt: skip


def seeds_of(split: str, count: int) -> list[int]:
    """The first seeds of a split.

    Raises:
        SettingError: for another split, or more scenes than it has.
    """
    require(split in SPLITS, "split", split, "one of " + ", ".join(SPLITS))
    first, most = SPLITS[split]
    require(1 <= count <= most, "scenes", count, f"1 to {most}, the scenes of {split}")
    return list(range(first, first + count))


def fingerprint(families: tuple[str, ...]) -> dict[str, str]:
    """A hash for each family of what its scenes, head and sensor are made of, with the protocol's version."""
    found = {}
    for name in families:
        node: Any = OmegaConf.masked_copy(compose_search(FAMILIES[name]), ["scene", "head", "eligibility", "far_m"])
        text = json.dumps([VERSION, SPLITS, OmegaConf.to_container(node, resolve=True)], sort_keys=True)
        found[name] = hashlib.sha256(text.encode()).hexdigest()[:16]
    return found
