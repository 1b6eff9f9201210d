"""The extras: what each brings to a user, and of which packages it is made."""

from __future__ import annotations

import importlib.metadata
import importlib.util
from typing import NamedTuple

__all__ = ["DEFAULTS", "EXTRAS", "Extra", "extra_of", "install", "is_there", "version"]


class Extra(NamedTuple):
    """An extra of pyproject.toml.

    Attributes:
        brings: what it is for.
        packages: the module that is imported, and the distribution that has it.
    """

    brings: str
    packages: dict[str, str]


EXTRAS = {
    "sim": Extra("simulated worlds: search, and most else", {"mujoco": "mujoco"}),
    "stereo": Extra("matcher=sgbm, the default of search", {"cv2": "opencv-python-headless"}),
    "viz": Extra("pictures", {"matplotlib": "matplotlib"}),
    "samples": Extra(
        "a real pair and digits: sense pair=motorcycle", {"skimage": "scikit-image", "sklearn": "scikit-learn"}
    ),
    "sweep": Extra(
        "sweeps on all cores, or on a cluster",
        {
            "hydra_plugins.hydra_joblib_launcher": "hydra-joblib-launcher",
            "hydra_plugins.hydra_submitit_launcher": "hydra-submitit-launcher",
        },
    ),
    "ray": Extra("sweeps with Ray", {"hydra_plugins.hydra_ray_launcher": "hydra-ray-launcher", "ray": "ray"}),
    "tune": Extra("tuning without gradients, to compare with", {"cma": "cma", "optuna": "optuna"}),
    "onnx": Extra("stereo networks in files: matcher=onnx", {"onnxruntime": "onnxruntime"}),
    "ros": Extra("ROS 2 bags: replay recording=BAG", {"rosbags": "rosbags"}),
    "rl": Extra("an environment to learn in: torchfovea.envs", {"gymnasium": "gymnasium"}),
    "ppo": Extra("policies trained by PPO: acquisition=trained", {"stable_baselines3": "stable-baselines3"}),
    "rerun": Extra("recordings for the viewer Rerun", {"rerun": "rerun-sdk"}),
    "docs": Extra("the documentation as a site", {"material": "mkdocs-material", "mkdocstrings": "mkdocstrings"}),
}
# what the commands use unless told otherwise
DEFAULTS = ("sim", "stereo", "viz")


def extra_of(module: str) -> str | None:
    """The extra that brings a module; None where none does."""
    for name, extra in EXTRAS.items():
        if module in (top.partition(".")[0] for top in extra.packages):
            return name
    return None


def install(*extras: str) -> str:
    """The line that installs extras."""
    return f"pip install 'torchfovea[{','.join(extras)}]'"


def is_there(module: str) -> bool:
    """Whether a module can be found, without importing it."""
    try:
        return importlib.util.find_spec(module) is not None
    except ModuleNotFoundError:  # of its parent
        return False


def version(distribution: str) -> str:
    """The version of an installed distribution; empty where there is none of that name."""
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return ""
