"""Active foveal stereo in PyTorch: where to look next, and how well each glance is known.

The names below are the library; each is documented in the module it comes from. Importing the package loads neither
MuJoCo nor Hydra nor matplotlib nor OpenCV.
"""

import os

# read when torch is loaded: threads that wait for each other by spinning took five times the CPU beside other work
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

from torchfovea.deciding.acquisition import (
    choose,
    expected_improvement,
    log_expected_improvement,
    upper_confidence_bound,
)
from torchfovea.gaussian import Gaussian, Information
from torchfovea.memory.egosphere import Fusion, Memory, Prior, belief, cartesian_belief, forget
from torchfovea.memory.moving import Motion, motion, move, resample
from torchfovea.memory.sphere import DirectionMixture, direction_mixture, log_density, sample
from torchfovea.memory.store import load_memory, save_memory
from torchfovea.memory.update import remember
from torchfovea.perception import Eligibility, Observer, compiled, decide, new_memory, perceive
from torchfovea.sensing.camera import Fisheye, Pinhole
from torchfovea.sensing.correspondence import Budget, Correspondences
from torchfovea.sensing.features import place_features, wrap_around
from torchfovea.sensing.head import Eyes, Gaze, Head, cyclopean, eyes, fixate
from torchfovea.sensing.layout import LogPolar, Uniform, cortical
from torchfovea.sensing.lens import BrownConrady, KannalaBrandt
from torchfovea.sensing.retina import fovea, interpolate, reconstruct
from torchfovea.sensing.triangulation import Observations, observe, triangulate
from torchfovea.sensing.unscented import SigmaPoints, unscented_transform
from torchfovea.setting import SettingError

__version__ = "0.1.0"

__all__ = [
    "BrownConrady",
    "Budget",
    "Correspondences",
    "DirectionMixture",
    "Eligibility",
    "Eyes",
    "Fisheye",
    "Fusion",
    "Gaussian",
    "Gaze",
    "Head",
    "Information",
    "KannalaBrandt",
    "LogPolar",
    "Memory",
    "Motion",
    "Observations",
    "Observer",
    "Pinhole",
    "Prior",
    "SettingError",
    "SigmaPoints",
    "Uniform",
    "belief",
    "cartesian_belief",
    "choose",
    "compiled",
    "cortical",
    "cyclopean",
    "decide",
    "direction_mixture",
    "expected_improvement",
    "eyes",
    "fixate",
    "forget",
    "fovea",
    "interpolate",
    "load_memory",
    "log_density",
    "log_expected_improvement",
    "motion",
    "move",
    "new_memory",
    "observe",
    "perceive",
    "place_features",
    "reconstruct",
    "remember",
    "resample",
    "sample",
    "save_memory",
    "triangulate",
    "unscented_transform",
    "upper_confidence_bound",
    "wrap_around",
]
