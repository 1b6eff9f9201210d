"""Shared fixtures; the environment is set here, before anything heavy is imported."""

import os

# Two workers with a pool of threads each only fight for the cores; child processes inherit this.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MPLBACKEND", "Agg")

import pytest
import torch
from hypothesis import settings
from legible import faults
from matplotlib.figure import Figure

# The same examples on every run, and no deadline: a shared machine stalls now and then.
settings.register_profile("torchfovea", derandomize=True, deadline=None, database=None)
settings.load_profile("torchfovea")


@pytest.fixture(params=[torch.float32, torch.float64], ids=["float32", "float64"])
def dtype(request):
    """Both precisions that every function takes."""
    return request.param


@pytest.fixture
def generator():
    """A seeded source of random numbers."""
    return torch.Generator().manual_seed(0)


@pytest.fixture(autouse=True)
def every_picture_is_legible(monkeypatch):
    """Whatever picture a test makes has names and units, writing of some size, and colours that all eyes tell apart."""
    found, save = [], Figure.savefig

    def looked_at(figure, *given, **options):
        save(figure, *given, **options)
        found.extend(faults(figure))

    monkeypatch.setattr(Figure, "savefig", looked_at)
    yield
    assert not found, "\n".join(dict.fromkeys(found))
