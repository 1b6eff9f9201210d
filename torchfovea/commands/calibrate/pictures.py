"""Picture of `torchfovea calibrate`: how honest claimed uncertainties are, before and after the fit."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import matplotlib
import numpy as np
from torch import Tensor

from torchfovea.commands.shared.pictures import PALETTE
from torchfovea.files import write_figure
from torchfovea.metrics import coverage
from torchfovea.studies.calibration import Judged

matplotlib.use("Agg")
from matplotlib.axes import Axes
from matplotlib.figure import Figure

__all__ = ["draw_calibration"]

NOMINAL = np.concatenate([np.linspace(0.02, 0.98, 49), [0.99, 0.995]])
REMOVED = np.linspace(0, 0.98, 99)


def draw_calibration(path: Path, data: Mapping[str, tuple[Judged, Mapping[str, Tensor]]]) -> None:
    """Draw reliability, the distribution of z and sparsification.

    Args:
        path: the PNG to write.
        data: by kind of data, a row each: the observations, and by model the claimed σ (N,) [1/m].
    """
    figure = Figure(figsize=(14, 4.5 * len(data)), layout="constrained")
    for row, (kind, (judged, models)) in zip(figure.subplots(len(data), 3, squeeze=False), data.items(), strict=True):
        error = judged.error.double()
        reliability, histogram, sparse = row
        reliability.plot([0, 1], [0, 1], color="0.5", ls=":", lw=1)
        size = np.asarray(error.abs())
        _curve(sparse, size, size, "0.5", "by the error itself")
        for colour, (model, sigma) in zip(PALETTE, models.items(), strict=False):
            z = error / sigma.double()
            reliability.plot(NOMINAL, np.asarray(coverage(z, NOMINAL.tolist())), color=colour, label=model)
            histogram.hist(
                np.asarray(z.clamp(-5, 5)), bins=np.linspace(-5, 5, 81).tolist(), density=True, histtype="step",
                color=colour, label=f"{model}: {float((z.abs() > 5).double().mean()):.2%} beyond 5",
            )  # fmt: skip
            _curve(sparse, size, np.asarray(sigma), colour, model)
        at = np.linspace(-5, 5, 201)
        histogram.plot(at, np.exp(-0.5 * at**2) / np.sqrt(2 * np.pi), color="0.5", ls=":", label="normal")
        reliability.set(
            xlabel="nominal coverage", ylabel="share of errors inside", title=f"{kind}: reliability", aspect="equal",
            xlim=(0, 1), ylim=(0, 1),
        )  # fmt: skip
        histogram.set(xlabel="z = error/σ of inverse range", title=f"{kind}: {len(error)} observations", yscale="log")
        histogram.set(ylim=(1e-4, 1), ylabel="density")
        sparse.set(xlabel="share removed, most uncertain first", ylabel="mean |error| of the rest, relative")
        sparse.set(title="sparsification", ylim=(0, None))
        for axes in row:
            axes.grid(alpha=0.3)
            axes.legend(fontsize=8)
    write_figure(path, figure, dpi=100)


def _curve(axes: Axes, size: np.ndarray, uncertainty: np.ndarray, colour: str, label: str) -> None:
    """Mean error of what is left, over the share removed; the mean of all is 1."""
    ranked = size[np.argsort(uncertainty, kind="stable")]
    mean = np.cumsum(ranked) / np.arange(1, len(ranked) + 1)
    left = np.maximum((np.round(len(ranked) * (1 - REMOVED))).astype(int), 1)
    axes.plot(REMOVED, mean[left - 1] / max(mean[-1], np.finfo(float).tiny), color=colour, label=label)
