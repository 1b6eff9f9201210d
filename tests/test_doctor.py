"""`torchfovea doctor`: which extras are there, and the line that installs what is missing."""

import re
import tomllib
from pathlib import Path

import pytest

from torchfovea.cli import main
from torchfovea.commands import doctor
from torchfovea.commands.shared import extras
from torchfovea.commands.shared.extras import DEFAULTS, EXTRAS, extra_of

ROOT = Path(__file__).resolve().parents[1]


def test_the_extras_are_those_of_the_package():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    stated = {
        name: {re.match(r"[\w-]+", need)[0] for need in needs if not need.startswith("torchfovea[")}
        for name, needs in project["optional-dependencies"].items()
        if name not in ("all", "dev")
    }
    assert {name: set(extra.packages.values()) for name, extra in EXTRAS.items()} == stated
    required = {re.match(r"[\w-]+", need)[0] for need in project["dependencies"]}
    assert set(doctor.REQUIRED) == required
    assert (extra_of("cv2"), extra_of("rosbags"), extra_of("numpy")) == ("stereo", "ros", None)


@pytest.mark.parametrize(
    ("gone", "said"),
    [
        ((), ["The defaults (rays, SGBM, pictures) can run."]),
        (
            ("cma",),
            ["The defaults (rays, SGBM, pictures) can run.", "For what is missing: pip install 'torchfovea[tune]'"],
        ),
        (
            ("cv2", "rosbags"),
            [
                "The defaults (rays, SGBM, pictures) cannot run: see above.",
                "For the defaults: pip install 'torchfovea[stereo]'",
                "For the rest: pip install 'torchfovea[ros]'",
            ],
        ),
    ],
)
def test_what_is_missing_is_named_with_the_line_that_installs_it(gone, said, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(extras.importlib.util, "find_spec", lambda module: None if module in gone else module)
    monkeypatch.setattr(doctor, "_devices", lambda timeout_s: [])
    monkeypatch.setattr(
        doctor, "_probe", lambda program, timeout_s: (["egl"] if "available_gl" in program else True, "")
    )
    assert main(["doctor"]) == 0
    printed = capsys.readouterr().out
    assert printed.splitlines()[-len(said) :] == said
    assert all(f"[{name}]" in printed for name in EXTRAS) and set(DEFAULTS) < set(EXTRAS)
