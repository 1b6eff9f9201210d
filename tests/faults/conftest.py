"""How many faults were injected, said at the end."""

import os
from collections import Counter

import pytest

INJECTED: Counter = Counter()


@pytest.fixture
def inject():
    """Called with a fault's kind, and how many, whenever one was injected."""

    def count(kind: str, number: int = 1) -> None:
        INJECTED[kind] += number

    return count


@pytest.fixture
def faults():
    """How many faults of a kind a test injects, times so many in the long profile (scripts/faults.sh)."""
    return int(os.environ.get("FAULTS", "1"))


def pytest_sessionfinish(session):
    if hasattr(session.config, "workeroutput"):
        session.config.workeroutput["injected"] = dict(INJECTED)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node):
    INJECTED.update(getattr(node, "workeroutput", {}).get("injected", {}))


def pytest_terminal_summary(terminalreporter):
    if INJECTED:
        kinds = ", ".join(f"{number} {kind}" for kind, number in sorted(INJECTED.items()))
        terminalreporter.write_line(f"faults injected: {sum(INJECTED.values())} ({kinds})")
