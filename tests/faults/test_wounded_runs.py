"""Runs that are killed, run out of space, or meet in one folder: nothing finished is lost, nothing broken is taken for
whole, and the restart ends as the undisturbed run did."""

import csv
import hashlib
import json
import os
import random
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

TINY = [
    "fidelity=geometric", "saccades=2", "sensor.receptive_fields=200", "memory.cells=60", "picture=false",
]  # fmt: skip
COMMANDS = {
    "search": ["search", *TINY, "episodes=6", "batch=2"],
    "sweep": ["search", "--multirun", *TINY, "episodes=1", "acquisition=ucb,pi,random"],
    "tune": [
        "tune", "profile=quick", "episodes=48", "validations=3", "validation_scenes=8", "heldout_scenes=8",
        "prior_field=false", "memory.cells=60", "sensor.receptive_fields=100", "saccades=2", "methods=[]",
    ],
    "reproduce": [
        "reproduce", "profile=quick", "episodes=2", "saccades=2", "workers=1", "memory.cells=120",
        "sensor.receptive_fields=200", "fig8.fov_deg=[135]", "fig8.alphas.few=[0]", "fig8.others=[pi]",
        "fig9.biases=[unbiased]", "fig9.alphas=[100]", "fig5.distances_m=[0.2,0.5]", "fig5.vergences=3",
    ],
    "benchmark": [
        "benchmark", "profile=quick", "tracks=[policy]", "families=[open]", "entries=[]",
        "mine=[{name:a,track:policy,config:['acquisition=ei']},{name:b,track:policy,config:['acquisition=pi']}]",
    ],
    "recording": [
        "search", "record=true", "renderer=rays", "episodes=2", "saccades=3", "sensor.source_px=96", *TINY[2:],
    ],
}  # fmt: skip
# the suite wounds a few; scripts/faults.sh all of them, many times
LONG = int(os.environ.get("FAULTS", "1")) > 1
TIMES = ("seconds", "created", "date", "time")  # what no two runs share


@pytest.fixture(scope="module")
def surgery():
    """Carries out an order, see `wounded.py`."""
    script = Path(__file__).with_name("wounded.py")
    with subprocess.Popen(
        [sys.executable, str(script)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        env={**os.environ, "COLUMNS": "100"},
    ) as process:  # fmt: skip
        assert process.stdin is not None and process.stdout is not None

        def carry_out(*runs):
            process.stdin.write(json.dumps(runs) + "\n")
            process.stdin.flush()
            return json.loads(process.stdout.readline())

        yield carry_out
        process.stdin.close()


def command(name, folder):
    return [*COMMANDS[name], f"hydra.{'sweep' if name == 'sweep' else 'run'}.dir={folder}"]


def content(folder):
    """What a run found: its tables and figures, without its times."""
    found = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.suffix == ".png" and "recording" in path.parts:
            found[name] = hashlib.sha256(path.read_bytes()).hexdigest()
        elif path.name == "result.json" or path.parent.name in ("episodes", "records"):
            found[name] = timeless(json.loads(path.read_text()))
        elif path.suffix == ".csv":
            with path.open() as file:
                found[name] = [timeless(row) for row in csv.DictReader(file)]
    assert found
    return found


def timeless(value):
    if isinstance(value, dict):
        return {k: timeless(v) for k, v in value.items() if not any(word in k for word in TIMES)}
    return [timeless(v) for v in value] if isinstance(value, list) else value


def finished(folder):
    return {path: path.stat().st_mtime_ns for path in folder.rglob("result.json")}


@pytest.fixture(scope="module")
def whole(surgery, tmp_path_factory):
    """A command's undisturbed run: what it found, how long it took, and its folder."""
    kept = {}

    def run(name):
        if name not in kept:
            folder = tmp_path_factory.mktemp("whole") / name
            (done,) = surgery({"arguments": command(name, folder)})
            assert done["status"] == 0, done["said"]
            kept[name] = content(folder), done["seconds"], folder
        return kept[name]

    return run


@pytest.mark.parametrize("name", COMMANDS if LONG else ["sweep", "tune", "reproduce"])
def test_a_killed_run_goes_on_to_the_same_end(surgery, whole, tmp_path, name, inject, faults):
    expected, seconds, _ = whole(name)
    source, folder, killed, before = random.Random(name), tmp_path / "run", 0, {}
    for k in range(faults):
        (done,) = surgery({"arguments": command(name, folder), "kill_after_s": source.uniform(0.05, 0.95) * seconds})
        if done["status"] == 0:  # it was faster
            folder, before = tmp_path / f"run-{k}", {}
            continue
        assert done["status"] == -9, done["said"]
        killed += 1
        assert before.items() <= finished(folder).items()  # nothing finished was made again
        before = finished(folder)
    (done,) = surgery({"arguments": command(name, folder)})
    assert done["status"] == 0, done["said"]
    assert before.items() <= finished(folder).items()
    assert content(folder) == expected
    assert not list(folder.rglob(".unfinished-*"))
    inject("kills", killed)


@pytest.mark.parametrize("name", ["search", "tune", "reproduce"] if LONG else ["search"])
def test_a_full_disk_is_named_and_nothing_is_lost(surgery, whole, tmp_path, name, inject, faults):
    expected, *_ = whole(name)
    source, folder = random.Random(name), tmp_path / "run"
    for _ in range(faults):
        (done,) = surgery({"arguments": command(name, folder), "file_bytes": source.choice((0, 300, 1000, 3000))})
        assert done["status"] == 1, done["said"]
        assert str(tmp_path) in done["said"] and "File too large" in done["said"], done["said"]
        assert "Traceback" not in done["said"], done["said"]
        assert not finished(tmp_path)
        inject("full disks")
    (done,) = surgery({"arguments": command(name, folder)})
    assert done["status"] == 0, done["said"]
    assert content(folder) == expected


@pytest.mark.parametrize("name", ["search", "sweep", "tune"] if LONG else ["search"])
def test_two_in_one_folder_leave_what_one_would(surgery, whole, tmp_path, name, inject):
    expected, *_ = whole(name)
    run = {"arguments": command(name, tmp_path / "run")}
    done = surgery(run, run)
    assert [one["status"] for one in done] == [0, 0], done
    assert content(tmp_path / "run") == expected
    inject("meetings in one folder")


@pytest.mark.parametrize("name", COMMANDS if LONG else ["tune"])
def test_a_changed_digit_is_named_or_made_again(surgery, whole, tmp_path, name, inject, faults):
    """In whatever of a finished run is data; its manifests too."""
    expected, _, made = whole(name)
    source, folder = random.Random(name), tmp_path / "run"
    shutil.copytree(made, folder)
    data = [path for path in sorted(folder.rglob("*")) if path.suffix in (".csv", ".json", ".yaml")]
    data = [path for path in data if path.parent.name != ".hydra"]  # what Hydra would have written, and nobody reads
    for _ in range(3 * faults):
        path = source.choice(data)
        before = path.read_text()
        at = source.choice([k for k, letter in enumerate(before) if letter.isdigit()])
        path.write_text(before[:at] + str((int(before[at]) + source.randrange(1, 10)) % 10) + before[at + 1 :])
        (done,) = surgery({"arguments": command(name, folder)})
        where = str(path.relative_to(folder)), before[max(at - 40, 0) : at + 40], done["said"]
        if done["status"] == 0:
            assert content(folder) == expected, where
        else:
            # what a manifest says of the others may be what was changed
            named = path.name in done["said"] or (path.name == "manifest.json" and str(path.parent) in done["said"])
            assert named and "Traceback" not in done["said"], where
        path.write_text(before)
        inject("changed digits")
    (done,) = surgery({"arguments": command(name, folder)})
    assert done["status"] == 0 and content(folder) == expected, done["said"]


def test_a_folder_that_cannot_be_written_is_named(surgery, inject):
    place = "/proc/torchfovea"
    (done,) = surgery({"arguments": command("search", place)})
    assert done["status"] != 0 and place in done["said"], done
    assert "Traceback" not in done["said"]
    inject("unwritable folders")
