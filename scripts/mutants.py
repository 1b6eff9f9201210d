"""Whether the tests notice small faults in the mathematical core: plants each, runs what would see it, keeps count.

    python scripts/mutants.py --out FOLDER [--seconds 300] [--only deciding.reward] [--start 8] [--again]

Nothing is written into the tree: one process imports the package and collects the tests once; for every fault it forks,
and the child alone changes the functions in its memory and runs the tests that reach the changed line, the fastest
first, until one fails. What is known stands in FOLDER (mutants.jsonl, reach.json) and is not done again, so that the
work can be cut into slices of some seconds. Survivors that no test can see are explained in scripts/mutants.toml.
"""

from __future__ import annotations

import argparse
import gc
import hashlib
import importlib
import json
import os
import resource
import sys
import time
import tomllib
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any

import pytest
from mutations import Mutant, mutants_of, mutated

ROOT = Path(__file__).resolve().parents[1]
CORE = (
    "gaussian",
    "sensing.unscented",
    "sensing.triangulation",
    "sensing.chart",
    "memory.sphere",
    "memory.pooling",
    "memory.update",
    "memory.egosphere",
    "deciding.reward",
    "deciding.acquisition",
    "metrics",
)
TESTS = (
    "gaussian unscented triangulation chart sphere egosphere memory voting encoders expected store moving reward "
    "acquisition policies infomax metrics propagation fuzz corners"
).split()
STATES = {0: "survived", 1: "killed", 2: "killed at import", -1: "killed by time"}
LIMIT_S = 6.0  # of the tests of one fault, by what they took undisturbed


@cache
def source_of(module: str) -> tuple[Path, str]:
    """A core module's file and text."""
    path = ROOT / "torchfovea" / (module.replace(".", "/") + ".py")
    return path, path.read_text()


# --- one process, many faults ----------------------------------------------------------------------------------------


def graft(old: dict[str, Any], new: dict[str, Any], owner: str) -> None:
    """Give the functions, defaults and constants of a live module the code of another version of it.

    Functions keep their identity, so that whoever imported one runs the new code.
    """
    for name, value in new.items():
        before = old.get(name)
        if before is None or name.startswith("__"):
            continue
        if isinstance(value, type) and value.__module__ == owner:
            graft_class(before, value, owner)
        elif (mine := _function(value)) is not None:
            _give(_function(before), mine)
        elif isinstance(value, int | float | tuple) and value != before:
            for module in [m for m in list(sys.modules.values()) if getattr(m, "__dict__", {}).get(name) is before]:
                setattr(module, name, value)


def graft_class(old: Any, new: Any, owner: str) -> None:
    """The same for a class; a dataclass's and a named tuple's defaults lie in generated functions."""
    for name, value in vars(new).items():
        before = vars(old).get(name)
        if (mine := _function(value)) is not None and name not in ("__annotations__",):
            _give(_function(before), mine)
        elif isinstance(value, bool | int | float) and value != before:
            setattr(old, name, value)


def _function(value: Any) -> FunctionType | None:
    for inner in ("__wrapped__", "__func__", "fget", "func"):
        if not isinstance(value, FunctionType) or inner == "__wrapped__":
            value = getattr(value, inner, value)
    return value if isinstance(value, FunctionType) else None


def _give(old: FunctionType | None, new: FunctionType) -> None:
    if old is not None and len(old.__code__.co_freevars) == len(new.__code__.co_freevars):
        old.__code__, old.__defaults__, old.__kwdefaults__ = new.__code__, new.__defaults__, new.__kwdefaults__


def plant(mutant: Mutant) -> None:
    """Change the functions of this process."""
    path, source = source_of(mutant.module)
    name = f"torchfovea.{mutant.module}"
    fresh = ModuleType(name)
    fresh.__file__ = str(path)
    exec(compile(mutated(source, mutant), str(path), "exec"), fresh.__dict__)
    graft(vars(importlib.import_module(name)), vars(fresh), name)


def in_child(work: Callable[[], int], limit_s: float) -> int:
    """The exit code of work done in a forked process that nobody hears; -1 where it did not end in time."""
    pid = os.fork()
    if pid == 0:
        code = 70
        try:
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, 1)
            os.dup2(null, 2)
            resource.setrlimit(resource.RLIMIT_AS, (16 << 30, 16 << 30))
            code = work()
        except BaseException:
            traceback.print_exc()
        finally:
            os._exit(code)
    until = time.monotonic() + limit_s
    while time.monotonic() < until:
        done, status = os.waitpid(pid, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.005)
    os.kill(pid, 9)
    os.waitpid(pid, 0)
    return -1


def children_s() -> float:
    """CPU seconds of all children so far."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


class Runner:
    """A pytest plugin that takes the place of the loop over the tests."""

    def __init__(self, given: argparse.Namespace) -> None:
        self.given, self.failed = given, False
        self.out = Path(given.out)

    def pytest_collection(self) -> None:
        """Look for a failing example, but do not shrink it."""
        from hypothesis import Phase, settings  # pytest wants to be there first

        phases = (Phase.explicit, Phase.generate)
        settings.register_profile("mutants", settings.get_profile("torchfovea"), phases=phases)
        settings.load_profile("mutants")

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Remember a failure."""
        self.failed |= report.failed

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Plant every fault that is not known yet."""
        self.items = {item.nodeid: item for item in session.items}
        reach = self.reach()
        gc.freeze()  # what is there is shared by the children
        for mutant in pending(self.given, self.out) if reach is not None else ():
            if children_s() > self.given.seconds:
                print("more to do")
                break
            tests = reached(mutant, reach)
            began = children_s()
            code = in_child(partial(self.judge, mutant, tests), 30 + 10 * LIMIT_S) if tests else 0
            state = STATES.get(code, "killed by crash")
            line = {**mutant._asdict(), "state": state, "tests": len(tests)}
            with (self.out / "mutants.jsonl").open("a") as file:
                file.write(json.dumps(line, ensure_ascii=False) + "\n")
            if state == "survived" or self.given.verbose:
                print(
                    f"{state:10} {children_s() - began:5.2f}s {mutant.module}:{mutant.line} {mutant.change}", flush=True
                )
        return True

    def judge(self, mutant: Mutant, tests: list[str]) -> int:
        """In a child: 0 where all tests pass, 1 where one fails, 2 where the module cannot even be imported."""
        try:
            plant(mutant)
        except BaseException:
            return 2
        for k, name in enumerate(tests):
            following = self.items[tests[k + 1]] if k + 1 < len(tests) else None
            self.run(name, following)
            if self.failed:
                return 1
        return 0

    def run(self, name: str, following: Any = None) -> None:
        """One test, as pytest runs it."""
        item = self.items[name]
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)

    def reach(self) -> dict[str, Any] | None:
        """For every test file, of each test its seconds and the core's lines that it runs; measured once a version.

        None where the time is up before all are measured.
        """
        path = self.out / "reach.json"
        known = json.loads(path.read_text()) if path.is_file() else {}
        core = hashlib.sha256("".join(source_of(m)[1] for m in CORE).encode()).hexdigest()
        files: dict[str, list[str]] = {}
        for name in self.items:
            files.setdefault(name.split("::")[0], []).append(name)
        for file, names in files.items():
            sha = hashlib.sha256((core + (ROOT / file).read_text()).encode()).hexdigest()
            if known.get(file, {}).get("sha") != sha:
                if children_s() > self.given.seconds:
                    print("more to do")
                    return None
                result = self.out / "reached.json"
                code = in_child(partial(self.measure, names, result), 1200)
                assert code == 0, f"{file}: exit code {code} without any fault"
                known[file] = {"sha": sha, **json.loads(result.read_text())}
                path.write_text(json.dumps(known))
                print(f"reach of {file}: {len(names)} tests", flush=True)
        for name in (m for file in files for m in known[file]["modules"]):
            with suppress(Exception):  # once here, not in every child
                importlib.import_module(name)
        return {name: test for file in files for name, test in known[file]["tests"].items()}

    def measure(self, names: list[str], result: Path) -> int:
        """In a child: run tests by themselves, line by line."""
        import coverage

        paths = {str(source_of(m)[0]): m for m in CORE}
        measured = coverage.Coverage(data_file=None, include=list(paths))
        seconds, before = {}, set(sys.modules)
        measured.start()
        for k, name in enumerate(names):
            self.failed, began = False, time.process_time()
            measured.switch_context(name)
            self.run(name, self.items[names[k + 1]] if k + 1 < len(names) else None)
            seconds[name] = time.process_time() - began
            if self.failed:
                seconds.pop(name)
        measured.stop()
        tests: dict[str, Any] = {name: {"s": s, "lines": {}} for name, s in seconds.items()}
        with warnings.catch_warnings(action="ignore"):  # some tests run nothing of the core
            data = measured.get_data()
        for path, module in paths.items():
            for line, contexts in data.contexts_by_lineno(path).items():
                for name in contexts:
                    if name in tests:
                        tests[name]["lines"].setdefault(module, []).append(line)
        result.write_text(json.dumps({"tests": tests, "modules": [m for m in sys.modules if m not in before]}))
        return 0


def reached(mutant: Mutant, reach: dict[str, Any]) -> list[str]:
    """The tests that run any line of the fault's, the fastest first; outside functions, any line of the module."""
    inside = set(range(mutant.first, mutant.last + 1))
    found = []
    for name, test in reach.items():
        lines = test["lines"].get(mutant.module, [])
        if lines and (mutant.first == 0 or not inside.isdisjoint(lines)):
            found.append((test["s"], name))
    kept, total = [], 0.0
    for seconds, name in sorted(found):
        total += seconds
        if total < LIMIT_S:
            kept.append(name)
    return kept


def pending(given: argparse.Namespace, out: Path) -> Iterator[Mutant]:
    """Faults whose fate is not known, in an order that says nothing, so that any beginning is a fair sample.

    With `again` those that survived and are not explained, too.
    """
    known, reasons = results(out), explained()
    every = [m for module in given.only or CORE for m in mutants_of(module, source_of(module)[1])]
    for mutant in sorted((m for m in every if m.key >= given.start), key=lambda m: m.key):
        state = known.get(mutant.key, {}).get("state")
        if state is None or (given.again and state == "survived" and mutant.key not in reasons):
            yield mutant


def results(out: Path) -> dict[str, Any]:
    """What is known, by key; a later line holds."""
    path = out / "mutants.jsonl"
    lines = path.read_text().splitlines() if path.is_file() else []
    return {line["key"]: line for line in map(json.loads, lines)}


def explained() -> dict[str, str]:
    """Why no test can see a fault, by key."""
    found = tomllib.loads((ROOT / "scripts" / "mutants.toml").read_text())
    return {key: reason["why"] for reason in found["reason"] for key in reason["keys"]}


def table(out: Path) -> str:
    """Killed, survived, equivalent: a Markdown table of the modules."""
    known, reasons = results(out), explained()
    rows = ["| module | mutants | killed | equivalent | survived | killed of those that differ |", "|" + "---|" * 6]
    total: Counter[str] = Counter()
    for module in CORE:
        keys = [m.key for m in mutants_of(module, source_of(module)[1])]
        count = Counter(
            "killed" if known[k]["state"] != "survived" else "equivalent" if k in reasons else "survived"
            for k in keys
            if k in known
        )
        total += count
        rows.append(_row(module, count))
    every = sum(len(mutants_of(module, source_of(module)[1])) for module in CORE)
    low, high = interval(total["killed"], total["killed"] + total["survived"])
    said = f"{sum(total.values())} of {every} faults tried; killed of all that differ: {low:.1%} to {high:.1%} with 95%"
    return "\n".join([*rows, _row("all", total), "", said])


def interval(some: int, of: int, z: float = 1.96) -> tuple[float, float]:
    """Wilson's interval of a share."""
    share, n = some / max(1, of), max(1, of)
    middle, half = share + z * z / (2 * n), z * (share * (1 - share) / n + z * z / (4 * n * n)) ** 0.5
    return (middle - half) / (1 + z * z / n), (middle + half) / (1 + z * z / n)


def _row(name: str, count: Counter[str]) -> str:
    killed, same, left = (count[k] for k in ("killed", "equivalent", "survived"))
    share = f"{killed / max(1, killed + left):.1%}"
    return f"| {name} | {killed + same + left} | {killed} | {same} | {left} | {share} |"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--out", required=True, help="folder outside the tree")
    parser.add_argument("--seconds", type=float, default=1e9, help="of CPU, after which no further fault is begun")
    parser.add_argument("--only", nargs="*", help="modules of the core")
    parser.add_argument(
        "--start", default="", help="begin at faults of this key or a later one, a fresh sample of them"
    )
    parser.add_argument("--tests", nargs="*", default=TESTS, help="names of test files")
    parser.add_argument("--again", action="store_true", help="try survivors that are not explained again")
    parser.add_argument("--verbose", action="store_true", help="a line for every fault")
    given = parser.parse_args()
    Path(given.out).mkdir(parents=True, exist_ok=True)
    os.chdir(ROOT)
    files = [f"tests/test_{name}.py" for name in given.tests]
    options = ["-qq", "-s", "--tb=no", "-p", "no:cacheprovider", "-o", "timeout=120"]
    code = pytest.main([*options, *files], plugins=[Runner(given)])
    print(table(Path(given.out)))
    sys.exit(code)
