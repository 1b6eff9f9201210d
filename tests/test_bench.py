"""The bench: its checks see through stubs, its times and slopes are right, the command writes what it promises."""

import csv
import dataclasses
import json
import math
import subprocess
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from torchfovea.cli import main
from torchfovea.commands.bench import against, builders, paths, retina_paths, steps, timing
from torchfovea.commands.bench import command as bench
from torchfovea.commands.bench.look import saccade
from torchfovea.commands.bench.memory import peak_bytes
from torchfovea.commands.bench.timing import Growth, Path, copy_bandwidth, interleaved, nbytes, same, slope
from torchfovea.memory import sphere
from torchfovea.memory.egosphere import Fusion
from torchfovea.perception import Observer
from torchfovea.sensing.head import fixate
from torchfovea.sensing.layout import LogPolar
from torchfovea.setting import SettingError

FULL = Observer(retina=LogPolar(1500))
PLAIN = dataclasses.replace(FULL, fusion=Fusion(fill=False, conflict=math.inf))
TINY = (
    "profile=quick", "seconds=0.01", "threads=1", "sensor.receptive_fields=1200", "memory.cells=600", "batch=2",
    "small.receptive_fields=600", "small.cells=300", "saccades=2", "tuning.episodes=8", "tuning.cells=20",
    "sensor.source_px=64",
)  # fmt: skip


def cells(count=700):
    reach = lambda d: fixate(FULL.head, d)[1]  # noqa: E731
    return sphere.reachable_directions(sphere.fibonacci_directions, count, reach).float()


@pytest.fixture(scope="module")
def look():
    return saccade(PLAIN, cells())


def test_ours_and_every_peer_compute_the_same(look):
    with torch.no_grad():
        made = paths.paths_of_look(look) + steps.paths_of_steps(look, FULL)
        made += [steps.batched_steps(PLAIN, cells(300), 2, "cpu")]
        made += retina_paths.path_of_retina(LogPolar(1500), 100, 2, "cpu")
        for path in made:
            path.check()
            for growth in path.growths:
                assert len(growth.sizes) == len(growth.runs) and list(growth.sizes) == sorted(growth.sizes)
                growth.runs[0]()
    assert [p.name for p in made] == [
        "triangulate_ut", "align", "fuse", "fuse", "decide", "step", "step", "step", "retina", "retina"
    ]  # fmt: skip
    assert all(path.moved > 0 for path in made)


@pytest.mark.parametrize("alpha", [0.0, 2.0, 1000.0])
def test_the_peers_decide_by_the_observers_alpha(look, alpha):
    for path in steps.paths_of_steps(look._replace(alpha=alpha), FULL):
        path.check()


def _wrong(result):
    """A result of the right shapes with other numbers."""
    if isinstance(result, tuple):
        return type(result)(*map(_wrong, result)) if hasattr(result, "_fields") else tuple(map(_wrong, result))
    if isinstance(result, torch.Tensor) and result.is_floating_point():
        return 1.3 * result + 0.1
    return result


@pytest.mark.parametrize("name", ["observe", "nearest_cell", "pool", "pool_patches", "decide", "perceive", "fovea"])
def test_a_stub_is_not_timed(look, name, monkeypatch):
    module = retina_paths if name == "fovea" else steps if name in ("decide", "perceive") else paths
    right = getattr(module, name)
    broken = False
    monkeypatch.setattr(module, name, lambda *args, **kw: _wrong(right(*args, **kw)) if broken else right(*args, **kw))
    if name == "fovea":
        made = retina_paths.path_of_retina(LogPolar(800), 64, 1, "cpu")
    else:
        made = paths.paths_of_look(look) + steps.paths_of_steps(look, FULL)
    broken = True

    def refused(path):
        try:
            path.check()
        except (RuntimeError, IndexError):
            return True
        return False

    assert any(map(refused, made))


def test_same_says_what_differs():
    same("x", torch.ones(3), np.ones(3), 0)
    same("x", [1.0, 2.0, 30.0, 4.0], [1.0, 2.0, 3.0, 4.0], 1e-6, 0.75)
    with pytest.raises(RuntimeError, match="x: ours and the peer's differ by up to 27"):
        same("x", [1.0, 2.0, 30.0, 4.0], [1.0, 2.0, 3.0, 4.0], 1e-6)
    for ours, theirs in (([1.0], [1.0, 1.0]), ([], []), ([math.nan], [math.nan])):
        with pytest.raises(RuntimeError):
            same("x", ours, theirs, 1)


def test_times_are_medians_taken_in_turns(monkeypatch):
    """By a clock that only the work moves."""
    order, now = [], [0.0]
    clock = SimpleNamespace(perf_counter=lambda: now[0], process_time=lambda: 2 * now[0], sleep=lambda seconds: None)
    monkeypatch.setattr(timing, "time", clock)

    def work(name, seconds):
        order.append(name)
        now[0] += seconds

    slow, fast = interleaved([lambda: work("slow", 0.012), lambda: work("fast", 0.002)], 0.2)
    assert slow.runs == fast.runs >= 3
    assert slow[:4] == pytest.approx((12, 12, 12, 24)) and fast[:4] == pytest.approx((2, 2, 2, 4))
    assert order[:8] == ["slow", "fast", "slow", "fast", "fast", "slow", "slow", "fast"]
    assert len(order) == 2 * (slow.runs + 1)
    order.clear()
    assert interleaved([lambda: work("one", 0.001)], 0.0, warm=True)[0].runs == len(order) == 3


@pytest.mark.parametrize("power", [0.0, 0.5, 1.0, 2.0])
def test_slopes_are_powers(power):
    assert slope([10, 20, 40], [3 * size**power for size in (10, 20, 40)]) == pytest.approx(power)


def test_bytes_and_bandwidth():
    assert nbytes(torch.ones(3, 2), (torch.ones(5, dtype=torch.float64), 7), None) == 24 + 40
    assert 1e8 < copy_bandwidth(0.01) < 1e13


def test_memory_is_what_a_call_holds_at_most():
    held = peak_bytes(lambda: torch.ones(1 << 24).add_(torch.ones(1 << 24)))
    assert held is None or 1 << 26 < held < 1 << 28


def test_a_commits_files_are_put_aside(tmp_path):
    git = ["git", "-C", str(tmp_path / "repository"), "-c", "user.name=n", "-c", "user.email=e"]
    (tmp_path / "repository").mkdir()
    for text, *commands in (("one", ["init", "-q"]), ("two",)):
        (tmp_path / "repository" / "file").write_text(text)
        for command in (*commands, ["add", "file"], ["commit", "-q", "-m", text]):
            subprocess.run([*git, *command], check=True)
    name = against.checkout(tmp_path / "repository", "HEAD^", tmp_path)
    assert (tmp_path / "file").read_text() == "one" and len(name) == 40
    with pytest.raises(SettingError, match="against = never: expected a commit"):
        against.checkout(tmp_path / "repository", "never", tmp_path)


TREE = """
from types import SimpleNamespace
PATHS = ("step", "align")
def builders_of(cfg, device, wanted):
    def path(name, units):
        return SimpleNamespace(name=name, work="so much", units=units, run=lambda: sum(range(200_000)))
    return [lambda: [path(name, units) for name, units in NAMES]]
"""


def tree(folder, names):
    """A package of which only the bench is there, with paths of some names and units."""
    for package in ("", "commands", "commands/bench", "commands/shared"):
        (folder / "torchfovea" / package).mkdir(parents=True)
        (folder / "torchfovea" / package / "__init__.py").touch()
    (folder / "torchfovea/commands/bench/builders.py").write_text(f"NAMES = {names}\n{TREE}")
    (folder / "torchfovea/commands/shared/config.py").write_text(f"def conf_dir(): return {str(folder)!r}\n")
    (folder / "bench.yaml").write_text("device: cpu\nthreads: 1\npaths: null\n")
    return folder


def test_two_trees_take_turns(tmp_path):
    one = tree(tmp_path / "one", [("step", 4), ("align", 1), ("step", 1)])
    other = tree(tmp_path / "other", [("align", 1), ("step", 1), ("step", 1)])
    sides = [against._Side(folder, ["threads=1"], folder.name) for folder in (one, other)]
    try:
        rows = against.in_turns(*sides, 0.0)
    finally:
        for side in sides:
            side.close()
    assert [(row.path, row.runs) for row in rows] == [("step", 5), ("align", 5), ("step", 5)]
    assert rows[0].least_ratio > 2 * rows[2].least_ratio > 0  # of a quarter of the same work
    assert all(row.ratio == pytest.approx(row.then_cpu_ms / row.cpu_ms) for row in rows)
    with pytest.raises(SettingError, match=r"against = old: expected a commit whose bench .* \(.*no_such.*\)"):
        against._Side(other, ["no_such=1"], "old")


def test_a_history_grows_by_lines(tmp_path):
    for number in range(2):
        against.add_line(tmp_path / "folder" / "history.jsonl", {"number": number})
    lines = (tmp_path / "folder" / "history.jsonl").read_text().splitlines()
    assert [json.loads(line)["number"] for line in lines] == [0, 1]
    with pytest.raises(SettingError, match=r"history = .*: expected a file that can be written"):
        against.add_line(tmp_path, {})


def run(tmp_path, *overrides):
    return main(["bench", *TINY, f"hydra.run.dir={tmp_path}/run", *overrides])


def test_the_command(tmp_path, capsys):
    assert run(tmp_path) == 0, capsys.readouterr().err
    out = capsys.readouterr().out
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    for name in bench.PATHS:
        assert name in out
        ours, theirs, ratio = (result[f"{name}.{key}"] for key in ("median_ms", "peer_median_ms", "ratio"))
        assert ours > 0
        if name in ("render", "saccade") and theirs is None:
            assert ratio is None
        else:
            assert ratio == pytest.approx(theirs / ours)
    rows = list(csv.DictReader((tmp_path / "run" / "bench.csv").read_text().splitlines()))
    assert {row["path"] for row in rows} == set(bench.PATHS)
    assert set(bench._COLUMNS) == set(rows[0])
    for row in rows:
        assert row["device"] == "cpu" and row["work"]
        assert float(row["low_ms"]) <= float(row["median_ms"]) <= float(row["high_ms"])
    step = next(row for row in rows if row["path"] == "step")
    assert float(step["bytes"]) > 0 and float(step["over_copy"]) > 0
    assert math.isfinite(float(step["slope_rfs"])) and math.isfinite(float(step["slope_cells"]))
    assert out.strip().splitlines()[-1] == str(tmp_path / "run")


def test_sweeps_are_timed_together_and_one_by_one(tmp_path, capsys):
    assert run(tmp_path, "paths=[saccade]", "matcher=sweep") == 0, capsys.readouterr().err
    rows = list(csv.DictReader((tmp_path / "run" / "bench.csv").read_text().splitlines()))
    assert [row["peer"] for row in rows] == ["", "one by one"] and "2 pairs together" in rows[1]["work"]


def test_some_paths_only(tmp_path, capsys):
    assert run(tmp_path, "paths=[align,decide]") == 0, capsys.readouterr().err
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    timed = {name for name in bench.PATHS if result[f"{name}.median_ms"] is not None}
    assert timed == {"align", "decide"}


@pytest.mark.parametrize(
    "override, said",
    [
        ("paths=[fly]", "paths = fly: expected some of retina"),
        ("device=tpu", "device = tpu: expected one of cpu, cuda"),
        ("sensor=uniform", "sensor.layout = uniform: expected log_polar"),
        ("sensor.camera=fisheye", "sensor.camera = fisheye: expected pinhole"),
        ("fusion=printed", "fusion = printed: expected inverse_range"),
        ("budget=printed", "budget.sigma_points = paper: expected ours"),
        ("batch=0", "batch = 0: expected at least 1"),
        ("seconds=-1", "seconds = -1: expected a positive number"),
        ("against=no_such_commit", "against = no_such_commit: expected a commit of the checkout"),
        ("history=h.jsonl", "history = h.jsonl: expected null, or against=COMMIT besides"),
    ],
)
def test_mistakes_are_worded(tmp_path, capsys, override, said):
    assert run(tmp_path, override) == 1
    assert said in capsys.readouterr().err


def test_a_path_that_does_something_else_fails_the_command(tmp_path, capsys, monkeypatch):
    def other(*_):
        def check():
            same("retina", [0.0], [1.0], 0)

        return [Path("retina", "", "cpu", lambda: None, (), check, growths=(Growth("RFs", (1,), (lambda: None,)),))]

    monkeypatch.setattr(builders, "path_of_retina", other)
    assert run(tmp_path, "paths=[retina]") == 1
    assert "differ" in capsys.readouterr().err
    assert not (tmp_path / "run" / "result.json").exists()
