"""The floors: imports point down, heavy packages stop at their floor, files stay short."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "torchfovea"
FILES = sorted(PACKAGE.rglob("*.py"))
LONGEST = 320

# folders whose modules have floors of their own; the others are on one floor each
ROOMS = {"sensing", "stereo", "memory", "deciding", "studies"}

# From the ground up. A module imports from its own floor (never in a circle) or from those below it.
FLOORS = (
    ("setting", "files", "untrusted", "imported", "compiling", "machine", "finite", "rounding", "allocation"),
    ("gaussian",),
    (
        "camera",
        "lens",
        "lattice",
        "layout",
        "own_layout",
        "features",
        "sampling",
        "triangles",
        "retina",
        "sheets",
        "head",
        "kinematics",
        "unscented",
        "chart",
        "significance",
    ),
    ("topology", "sphere", "cell_index", "nearest"),
    (
        "correspondence",
        "kinship",
        "visibility",
        "confidence",
        "sgbm",
        "semiglobal",
        "costs",
        "acuity",
        "subpixel",
        "exposure",
        "sparse",
        "health",
        "readings",
        "surfaces",
        "sweep",
        "meeting",
        "disparity_files",
        "calibration_content",
        "calibration_formats",
        "calibration_files",
        "external",
        "onnx_model",
        "matchers",
        "rig",
        "views",
        "rectification",
        "maps",
        "matching",
        "fields",
        "geometric",
        "marks",
        "stripes",
        "two_rays",
        "pinhole",
        "triangulation",
        "association",
        "classes",
        "counting",
        "pooling",
        "egosphere",
        "voting",
        "update",
        "encoders",
        "moving",
        "expected",
        "store",
    ),
    (
        "acquisition",
        "policies",
        "infomax",
        "weighted",
        "strategies",
        "reward",
        "worth",
        "eligibility",
        "metrics",
        "calibration",
        "fitting",
        "shared_errors",
        "characterization",
        "propagation",
        "plane",
        "realised",
    ),
    ("perception", "rows", "cloud"),
    ("search", "arena", "looking"),
    ("recordings",),
    ("tuning", "episode"),
    ("sim",),
    ("commands",),
    ("envs",),
    ("cli", "__main__"),
)
FLOOR = {module: floor for floor, modules in enumerate(FLOORS) for module in modules}

# Heavy packages, and the only modules (of the plan, or files anywhere by their stem) that may import them.
ONLY_IN = {
    "mujoco": {"sim"},
    "hydra": {"cli", "commands", "envs"},
    "omegaconf": {"cli", "commands", "envs"},
    "matplotlib": {"pictures"},
    "cv2": {
        "sgbm",
        "sparse",
        "untrusted",
        "volume",
        "calibration_formats",
        "recordings",
        "commands",
    },
    "rosbags": {"recordings"},
    "rich": {"cli", "commands"},
    "joblib": {"commands"},
    "skimage": {"commands"},
    "gymnasium": {"envs"},
    "stable_baselines3": {"envs"},
    "onnxruntime": {"onnx_model"},
}


def module_of(path):
    """The name on the floor plan: the first part below the package, or the second in a room of several floors."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    name = parts[1] if parts[0] in ROOMS else parts[0]
    return name if name != "__init__" else ""


def imports_of(path):
    """Every module that a file imports anywhere in it, as dotted names."""
    here = ("torchfovea", *path.relative_to(PACKAGE).parts[:-1])
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(here[: len(here) + 1 - node.level]) if node.level else ""
            name = ".".join(filter(None, (base, node.module)))
            # "from torchfovea import x" imports the module torchfovea.x, if there is one.
            yield from (f"{name}.{alias.name}" for alias in node.names) if name == "torchfovea" else (name,)


def inner_imports(path):
    for name in imports_of(path):
        package, _, rest = name.partition(".")
        parts = rest.split(".")
        module = parts[1] if parts[0] in ROOMS and len(parts) > 1 else parts[0]
        if package == "torchfovea" and module in FLOOR:
            yield module


def name_of(path):
    return str(path.relative_to(PACKAGE))


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_imports_point_down(path):
    module = module_of(path)
    if module == "":  # the package itself only re-exports
        return
    assert module in FLOOR, f"{module} has no floor yet: add it to FLOORS"
    above = sorted({other for other in inner_imports(path) if FLOOR.get(other, 0) > FLOOR[module]})
    assert not above, f"{module} imports from floors above it: {above}"


def test_no_circles():
    graph = {}
    for path in FILES:
        graph.setdefault(module_of(path), set()).update(set(inner_imports(path)) - {module_of(path)})
    done, open_ = set(), []

    def visit(module):
        assert module not in open_, f"a circle of imports: {[*open_, module]}"
        if module in done:
            return
        open_.append(module)
        for other in graph.get(module, ()):
            visit(other)
        done.add(open_.pop())

    for module in graph:
        visit(module)


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_heavy_packages_stop_at_their_floor(path):
    here = {module_of(path), path.stem}
    used = {name.partition(".")[0] for name in imports_of(path)}
    strays = sorted(package for package, allowed in ONLY_IN.items() if package in used and not here & allowed)
    assert not strays, f"{name_of(path)} may not import {strays}"


@pytest.mark.parametrize("path", sorted((PACKAGE / "commands").rglob("*.py")), ids=name_of)
def test_commands_share_only_what_is_shared(path):
    own = path.relative_to(PACKAGE / "commands").parts[0].removesuffix(".py")
    others = {
        name
        for name in imports_of(path)
        if name.startswith("torchfovea.commands.") and name.split(".")[2] not in {own, "shared"}
    }
    assert not others, f"the command {own} imports from another's folder: {sorted(others)}"


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_files_are_short_and_finished(path):
    text = path.read_text()
    assert len(text.splitlines()) <= LONGEST
    for unfinished in ("NotImplementedError", "TODO", "FIXME"):
        assert unfinished not in text


def test_acquisitions_are_plain_functions():
    modules = sorted((PACKAGE / "deciding").glob("*.py"))
    assert len(modules) > 4
    for path in modules:
        tree = ast.parse(path.read_text())
        attributes = {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
        assert "nn" not in attributes
        assert not any(name.startswith("torch.nn") for name in imports_of(path))


def test_the_plan_is_up_to_date():
    """No floor names a module twice."""
    assert sum(map(len, FLOORS)) == len(FLOOR)


def test_importing_torchfovea_is_light():
    heavy = ("mujoco", "hydra", "omegaconf", "matplotlib", "cv2", "skimage", "rich", "joblib", "kornia", "gymnasium")
    code = f"import sys, torchfovea; print([name for name in {heavy!r} if name in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == "[]"
