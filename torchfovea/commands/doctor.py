"""``torchfovea doctor``: what this machine has and can render, and what to install for what it lacks."""

from __future__ import annotations

import json
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from omegaconf import DictConfig

from torchfovea.commands.shared.config import conf_dir, run_folder
from torchfovea.commands.shared.extras import DEFAULTS, EXTRAS, install, is_there, version
from torchfovea.files import write_csv, write_result
from torchfovea.setting import require

__all__ = ["Finding", "run"]

# What `import torchfovea` and its command line need.
REQUIRED = ("torch", "kornia", "numpy", "scipy", "filterpy", "hydra-core", "joblib", "rich")

# Each probe runs in a process of its own: a broken GL set-up can end the process that imports MuJoCo, and MUJOCO_GL is
# read at that import. It prints one line of JSON last.
RAYS = """
import numpy as np
from torchfovea.sim.backend import load_mujoco
mujoco = load_mujoco()
spec = mujoco.MjSpec()
spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 1])
model = spec.compile()
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
distance, geom = np.zeros(1), np.zeros(1, np.int32)
mujoco.mj_multiRay(model, data, np.array([0.0, 0.0, 2.0]), np.array([0.0, 0.0, -1.0]), None, 1, -1, geom, distance,
                   None, 1, mujoco.mjMAXVAL)
assert abs(distance[0] - 2) < 1e-9, distance
print("true")
"""
SGBM = """
import cv2, numpy as np
left = np.random.default_rng(0).integers(0, 256, (64, 128), dtype=np.uint8)
disparity = cv2.StereoSGBM_create(0, 16, 5).compute(left, np.roll(left, -4, 1)) / 16
assert abs(np.median(disparity[:, 32:]) - 4) < 0.5, disparity
print("true")
"""
GL = """
import json
from torchfovea.sim.gl import available_gl
print(json.dumps(available_gl()))
"""


PROVIDERS = """
import json, onnxruntime
print(json.dumps([name.removesuffix("ExecutionProvider") for name in onnxruntime.get_available_providers()]))
"""


class Finding(NamedTuple):
    """A row of the table: what was looked for, what was found (empty: nothing), and what to know about it."""

    item: str
    found: str
    note: str


def run(cfg: DictConfig) -> None:
    """Look and print the table; with `save` also write ``doctor.csv`` and ``result.json``.

    Its ``ok`` says that the defaults, rays and SGBM, can run.

    Raises:
        SettingError: for a time limit that is not positive.
    """
    timeout_s = cfg.probe_timeout_s
    require(0 < timeout_s <= 1e6, "probe_timeout_s", timeout_s, "a positive number of seconds, at most 1e6")
    required = [name for name in REQUIRED if not version(name)]
    absent = [name for name, extra in EXTRAS.items() if not all(map(is_there, extra.packages))]
    rays, rays_error = _probe(RAYS, timeout_s)
    sgbm, sgbm_error = _probe(SGBM, timeout_s)
    gl, gl_error = _probe(GL, timeout_s)
    # A backend's name, a list of them, or nothing.
    backends = [gl] if isinstance(gl, str) else [str(name) for name in gl or []]
    compiler = _compiler()
    needed = [name for name in DEFAULTS if name in absent]
    ok = not required and not needed and rays is True and sgbm is True

    findings = [
        Finding("python", platform.python_version(), sys.executable),
        *(Finding(name, version(name), "" if version(name) else "needed") for name in REQUIRED),
        *(_extra(name) for name in EXTRAS),
        Finding("threads", str(torch.get_num_threads()), f"{os.cpu_count()} processors; OMP_NUM_THREADS sets them"),
        *_devices(timeout_s),
        Finding("C++ compiler", compiler, "" if compiler else "only torch.compile needs one"),
        Finding("renderer=rays", "works" if rays else "", rays_error),
        Finding("renderer=gl", ", ".join(backends), gl_error if not backends else ""),
        Finding("matcher=sgbm", "works" if sgbm else "", sgbm_error),
        Finding("configuration", conf_dir(), ""),
    ]
    _show(findings)
    print(f"The defaults (rays, SGBM, pictures) can{'' if ok else 'not'} run{'.' if ok else ': see above.'}")
    if needed:
        print(f"For the defaults: {install(*needed)}")
    if set(absent) - set(needed):
        print(f"For {'the rest' if needed else 'what is missing'}: {install(*(e for e in absent if e not in needed))}")
    if not cfg.save:
        return
    folder = run_folder()
    write_csv(folder / "doctor.csv", Finding._fields, findings)
    write_result(
        folder,
        {
            "ok": ok,
            "rays": rays is True,
            "sgbm": sgbm is True,
            "gl": bool(backends),
            "cuda": torch.cuda.is_available(),
            "missing": absent,
            "compiler": bool(compiler),
            "threads": torch.get_num_threads(),
        },
    )


def _extra(name: str) -> Finding:
    """An extra: the packages of it that are there, or what it would bring."""
    brings, packages = EXTRAS[name]
    there = [f"{kind} {version(kind)}".rstrip() for module, kind in packages.items() if is_there(module)]
    complete = len(there) == len(packages)
    return Finding(f"[{name}]", ", ".join(there), brings if complete else f"{brings}: {install(name)}")


def _devices(timeout_s: float) -> list[Finding]:
    """Where tensors can be computed besides the CPU, and where networks in files can run."""
    cuda = [torch.cuda.get_device_properties(k) for k in range(torch.cuda.device_count())]
    found = [Finding(f"cuda:{k}", d.name, f"{d.total_memory / 2**30:.0f} GiB: device=cuda") for k, d in enumerate(cuda)]
    if not found:
        found = [Finding("CUDA", "", "everything runs on the CPU")]
    if is_there("onnxruntime"):
        names, error = _probe(PROVIDERS, timeout_s)
        found.append(Finding("matcher=onnx", ", ".join(str(name) for name in names or []), error or "where it can run"))
    return found


def _compiler() -> str:
    names = (os.environ.get("CXX", ""), "g++", "clang++", "c++", "cl")
    return next((path for name in names if name and (path := shutil.which(name))), "")


def _probe(program: str, timeout_s: float) -> tuple[Any, str]:
    """Run a small program: what it printed, and else the last line of its error."""
    # The child finds the same package as this process, installed or not.
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    try:
        done = subprocess.run(
            [sys.executable, "-c", program], capture_output=True, text=True, timeout=timeout_s, env=environment
        )
        if done.returncode == 0:
            return json.loads(done.stdout.splitlines()[-1]), ""
    except subprocess.TimeoutExpired:
        return None, f"no answer within {timeout_s:g} s"
    lines = done.stderr.strip().splitlines()
    return None, lines[-1] if lines else f"ended with status {done.returncode}"


def _show(findings: Sequence[Finding]) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    for row in findings:
        table.add_row(row.item, row.found or "-", row.note, style=None if row.found else "dim")
    Console().print(table, markup=False)
