"""The benchmark: entries of every kind, records that repeat, and mistakes that stay with whoever made them."""

import json
import math
import sys

import numpy as np
import pytest
import torch
from scipy.stats import norm

from torchfovea.cli import main
from torchfovea.commands.benchmark import command, protocol
from torchfovea.commands.benchmark.entries import Entry
from torchfovea.commands.benchmark.protocol import SIZES, Size, fingerprint, seeds_of
from torchfovea.commands.benchmark.report import read_records
from torchfovea.commands.benchmark.tracks import _honesty
from torchfovea.setting import SettingError

TINY = Size(
    ("open",), dict.fromkeys(protocol.TRACKS, 1), {"policy": 3, "whole": 2}, 300, 80, 80, 300, (1, 2)
)  # fmt: skip

MODULE = """
import time
import torch
from torchfovea.memory.egosphere import Fusion, Prior, belief, empty_memory
from torchfovea.memory.update import remember
from torchfovea.stereo.matchers import Matcher
from torchfovea.stereo.sgbm import SGBM

def greedy(view):
    return view.mean

def raising(view):
    raise ZeroDivisionError("by nothing")

def unknown(view):
    return view.mean * float("nan")

def short(view):
    return view.mean[..., :3]

def slow(view):
    time.sleep(60)

def match(views, retina, budget):
    return Matcher(SGBM())(views, retina, budget)

def fuse(cells, looks):
    memory = empty_memory(cells, Prior())
    for look in looks:
        memory = remember(memory, look, Fusion())
    moments = belief(memory)
    return moments.mean[:, 2], torch.where(memory.looks > 0, moments.cov[:, 5].sqrt(), torch.inf)

def blind(views, retina, budget):
    found = match(views, retina, budget)
    return found[0]._replace(right_px=found[0].right_px * float("nan")), found[1]

def few(views, retina, budget):
    found = match(views, retina, budget)
    return found[0]._replace(right_px=found[0].right_px[:5]), found[1]

def forgetful(cells, looks):
    return cells[:, 0] * float("nan"), torch.ones(len(cells))
"""

PROGRAM = """
import json, sys
import numpy as np
kind = sys.argv[1]
if kind == "lines":
    for line in sys.stdin:
        seen = json.loads(line)
        best = max((m, -k) for k, (m, e) in enumerate(zip(seen["mean"], seen["eligible"])) if e)
        print(-best[1], flush=True)
elif kind == "beyond":
    for line in sys.stdin:
        print(10 ** 6, flush=True)
elif kind == "mute":
    sys.stdin.read()
elif kind == "gone":
    sys.exit(3)
else:
    given = np.load(sys.argv[2] + "/given.npz")
    if kind == "match":
        n = len(given["left_px"])
        answer = dict(right_px=given["left_px"] - [1.0, 0.0], sigma_px=np.ones(n), valid=np.ones(n, bool))
    else:
        n = len(given["cells"])
        answer = dict(mean=np.full(n, 0.5), std=np.full(n, 0.5))
    np.savez(sys.argv[2] + "/answer.npz", **answer)
"""


@pytest.fixture
def bench(tmp_path, monkeypatch, capsys):
    """Runs the command at a tiny size with entries of one's own, and reads its records."""
    (tmp_path / "theirs_of_benchmark.py").write_text(MODULE)
    (tmp_path / "program.py").write_text(PROGRAM)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setitem(command.SIZES, "quick", TINY)

    def run(entries, *overrides, folder="run"):
        listed = ",".join(
            "{" + ",".join(f"{key}:{json.dumps(value)}" for key, value in entry.items()) + "}" for entry in entries
        )
        words = ["benchmark", "profile=quick", f"mine=[{listed}]", f"hydra.run.dir={tmp_path / folder}", *overrides]
        status = main(words if entries is None or "entries" in str(overrides) else [*words, "entries=[]"])
        files = sorted((tmp_path / folder / "records").glob("*.json"))
        records = {r["entry"]["name"]: r for r in map(json.loads, map(lambda f: f.read_text(), files))}
        return status, records, capsys.readouterr()

    run.program = lambda kind: f"{sys.executable} {tmp_path / 'program.py'} {kind}"
    run.folder = tmp_path
    return run


def function(name, track, of):
    return {"name": name, "track": track, "function": f"theirs_of_benchmark:{of}"}


def without_times(record):
    return {key: value for key, value in record.items() if key != "times"}


def test_every_track_takes_functions_configurations_and_programs(bench):
    entries = [
        {"name": "ours", "track": "policy", "config": ["acquisition=ucb", "acquisition.alpha=0"]},
        function("their function", "policy", "greedy"),
        {"name": "their program", "track": "policy", "command": bench.program("lines")},
        {"name": "our matcher", "track": "matcher", "config": ["matcher=sgbm", "budget=ours"]},
        function("their matcher", "matcher", "match") | {"config": ["budget=ours"]},
        {"name": "matching program", "track": "matcher", "command": bench.program("match")},
        {"name": "our memory", "track": "memory", "config": ["fusion.gate_deg=0.8"]},
        function("their memory", "memory", "fuse"),
        {"name": "remembering program", "track": "memory", "command": bench.program("remember")},
        {"name": "all", "track": "whole", "config": ["budget=ours"]},
        function("all by theirs", "whole", "greedy"),
    ]
    status, records, said = bench(entries)
    assert status == 0 and len(records) == len(entries)
    assert not any(record["errors"] for record in records.values())
    rows = {name: record["families"]["open"]["rows"] for name, record in records.items()}
    assert all(len(part) == 1 and part[0]["seed"] == 30_000 for part in rows.values())
    # the same answer by another door is the same record
    assert rows["ours"] == rows["their function"] == rows["their program"]
    assert rows["our matcher"] == rows["their matcher"] != rows["matching program"]
    assert rows["our memory"][0]["nll.2"] == pytest.approx(rows["their memory"][0]["nll.2"], abs=0.2)
    assert rows["remembering program"][0]["sharpness.1"] != rows["our memory"][0]["sharpness.1"]
    assert records["their function"]["entry"]["source_hash"] and records["ours"]["versions"]["torch"]
    assert "## memory, open" in said.out and "| their program | " in said.out
    kept = {path: path.stat().st_mtime_ns for path in (bench.folder / "run" / "units").iterdir()}
    assert bench(entries)[1] == records  # resumed: nothing is run again, times included
    assert {path: path.stat().st_mtime_ns for path in kept} == kept
    again = bench(entries[:1] + entries[3:4] + entries[6:7], folder="again")[1]
    assert {name: without_times(r) for name, r in again.items()} == {
        name: without_times(records[name]) for name in again
    }
    status, _, _ = bench([], f"report={bench.folder / 'run'}", folder="report")
    drawn = [(bench.folder / place / "leaderboard.html").read_text() for place in ("run", "report")]
    assert status == 0 and drawn[0] == drawn[1] and "<table>" in drawn[0]


def test_mistakes_are_named_in_the_record_and_harm_nobody_else(bench):
    entries = [
        function("raises", "policy", "raising"), function("NaN", "policy", "unknown"),
        function("wrong shape", "policy", "short"),
        {"name": "beyond", "track": "policy", "command": bench.program("beyond")},
        {"name": "gone", "track": "policy", "command": bench.program("gone")},
        {"name": "not there", "track": "policy", "command": "/nowhere/program"},
        function("NaN memory", "memory", "forgetful"), function("good", "policy", "greedy"),
        function("NaN matches", "matcher", "blind"), function("few matches", "matcher", "few"),
        function("raises at last", "whole", "raising"),
        {"name": "no bias", "track": "policy", "config": ["memory=fitted_{family}"]},
    ]  # fmt: skip
    status, records, said = bench(entries)
    assert status == 0 and records["good"]["errors"] == {} and records["good"]["families"]["open"]["rows"]
    errors = {name: record["errors"]["open"] for name, record in records.items() if record["errors"]}
    expected = {
        "raises": "ZeroDivisionError: by nothing", "NaN": "scores = NaN: expected a number for every eligible cell",
        "wrong shape": "scores", "beyond": "command's answer = 1000000: expected a cell, 0 to 79", "gone": "command = ",
        "not there": "command = /nowhere/program: expected a program", "NaN memory": "memory's answer = NaN",
        "NaN matches": "matcher's", "few matches": "matcher's", "raises at last": "ZeroDivisionError: by nothing",
        "no bias": "memory = fitted_open",
    }  # fmt: skip
    assert set(errors) == set(expected)
    for name, line in expected.items():
        assert line in errors[name]
    assert "## What failed" in said.out and "| NaN | failed |" in said.out
    assert all(not records[name]["families"]["open"]["rows"] for name in errors)


def test_who_takes_too_long_is_stopped(bench):
    mute = {"name": "mute", "track": "policy", "command": bench.program("mute")}
    _, records, _ = bench([function("slow", "policy", "slow"), mute], "limit_s=1.5")
    assert records["slow"]["errors"] == {"open": "limit_s = 1.5: expected to be done in time"}
    assert "1.5" in records["mute"]["errors"]["open"] and records["slow"]["times"]["open"]["seconds"] < 50


@pytest.mark.parametrize(
    ("entry", "complaint"),
    [
        ({"name": "a", "track": "policy", "config": ["scene=cans"]}, "entry a: config = scene=cans"),
        ({"name": "a", "track": "sight", "config": ["x=1"]}, "entry a: track = sight"),
        ({"name": "a", "track": "policy"}, "entry a = nothing"),
        ({"name": "a/b", "track": "policy"}, "entry.name = a/b"),
        ({"name": "a", "track": "policy", "function": "nowhere:f"}, "entry a: function = nowhere:f"),
        ({"name": "a", "track": "policy", "speed": 1}, "mine = "),
    ],
)
def test_entries_that_cannot_take_part(bench, entry, complaint):
    status, records, said = bench([entry])
    assert status == 1 and not records and complaint in said.err


def test_settings_out_of_range(bench):
    good = [function("good", "policy", "greedy")]
    for override, complaint in (
        ("tracks=[sight]", "tracks = "), ("families=[closed]", "families = "), ("split=exam", "split = exam"),
        ("limit_s=0", "limit_s = 0"), ("report=/nowhere", "report = /nowhere"),
    ):  # fmt: skip
        status, _, said = bench(good, override)
        assert status == 1 and complaint in said.err
    with pytest.raises(SettingError, match=r"entries = .*: expected names"):
        raise_twice = [Entry("a", "policy", ("acquisition=ei",))] * 2
        command.entries_of(_as_config(raise_twice), ["policy"])


def _as_config(entries):
    from omegaconf import OmegaConf

    nodes = [{"name": e.name, "track": e.track, "config": list(e.config)} for e in entries]
    return OmegaConf.create({"entries": nodes, "mine": []})


def test_the_protocol_is_frozen():
    assert protocol.VERSION == "1"
    splits = [set(range(first, first + count)) for first, count in protocol.SPLITS.values()]
    assert not splits[0] & splits[1] and not splits[1] & splits[2] and not splits[0] & splits[2]
    assert seeds_of("test", 3) == [30_000, 30_001, 30_002]
    with pytest.raises(SettingError, match="scenes = 65"):
        seeds_of("test", 65)
    marks = fingerprint(SIZES["paper"].families)
    assert len(set(marks.values())) == len(marks) == 5


def test_records_that_disagree_are_not_one(tmp_path):
    record = {
        "track": "policy", "profile": "quick", "split": "test", "protocol": "1", "entry": {"name": "a"},
        "families": {}, "errors": {}, "times": {},
    }  # fmt: skip
    for name, families in (("x", {}), ("y", {"open": 1})):
        (tmp_path / f"{name}.json").write_text(json.dumps({**record, "families": families}))
    assert len(read_records([tmp_path / "x.json", tmp_path / "x.json"])) == 1
    with pytest.raises(SettingError, match="report = "):
        read_records([tmp_path])
    (tmp_path / "z.json").write_text("{}")
    with pytest.raises(SettingError, match="expected a record of torchfovea benchmark"):
        read_records([tmp_path / "z.json"])


def test_honesty_against_scipy():
    rng = np.random.default_rng(0)
    true, sigma = rng.uniform(0.3, 2, 4000), rng.uniform(0.01, 0.2, 4000)
    error, inlier = sigma * rng.standard_normal(4000), rng.uniform(0.5, 1, 4000)
    figures = _honesty(*(torch.from_numpy(part) for part in (error, sigma, true, inlier)))
    density = inlier * norm.pdf(error, 0, sigma) + (1 - inlier) * 0.3
    assert figures["nll"] == pytest.approx(-np.log(density).mean(), rel=1e-9)
    assert figures["sharpness"] == pytest.approx(np.sort(sigma / true)[1999], rel=1e-9)
    assert figures["coverage_50"] == pytest.approx((np.abs(error / sigma) <= norm.ppf(0.75)).mean())
    assert figures["coverage_95"] == pytest.approx(0.95, abs=0.02)
    assert math.isclose(figures["nees_mean"], 1, abs_tol=0.1) and figures["outlier_share"] == 0
