"""The installed wheel works away from the checkout, with its own configuration."""

import csv
import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


def run(*command, cwd, **environment):
    done = subprocess.run(
        command, capture_output=True, text=True, cwd=cwd, env={**os.environ, **environment}, timeout=280
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    run(sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", str(folder), str(ROOT), cwd=folder)
    (path,) = folder.glob("torchfovea-*.whl")
    return path


def test_the_wheel_holds_the_package_and_all_of_conf(wheel):
    names = set(zipfile.ZipFile(wheel).namelist())
    for source in (ROOT / "conf").rglob("*.yaml"):
        assert f"torchfovea/{source.relative_to(ROOT)}" in names
    for source in (path for kind in ("*.py", "*.c", "*.h") for path in (ROOT / "torchfovea").rglob(kind)):
        assert str(source.relative_to(ROOT)) in names
    assert "torchfovea/py.typed" in names  # whoever builds on it is type-checked against it
    tops = {name.partition("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"torchfovea"}


def test_the_installed_wheel_finds_its_own_conf(wheel, tmp_path):
    target, elsewhere = tmp_path / "site", tmp_path / "elsewhere"
    elsewhere.mkdir()
    pip = (sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index")
    run(*pip, "--target", str(target), str(wheel), cwd=elsewhere)
    out = run(sys.executable, "-m", "torchfovea", "doctor", "save=true", cwd=elsewhere, PYTHONPATH=str(target))
    folder = Path(out.splitlines()[-1])
    assert folder.is_relative_to(elsewhere)
    with (folder / "doctor.csv").open(newline="") as file:
        table = {row["item"]: row["found"] for row in csv.DictReader(file)}
    assert Path(table["configuration"]) == (target / "torchfovea" / "conf").resolve()
