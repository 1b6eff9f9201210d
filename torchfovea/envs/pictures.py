"""What a search knows, as a picture: ranges, inlier probabilities and informations on the map, and where it looks."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from torchfovea.envs.observations import memory_map, shown_of
from torchfovea.envs.rows import SearchRows
from torchfovea.sensing.head import Gaze, cyclopean

__all__ = ["draw_rows", "show"]

SCALE = 12  # picture pixels a place of the map
# from little to much: a few colours of viridis, between which is interpolated
_COLOURS = torch.tensor([[68, 1, 84], [59, 82, 139], [33, 145, 140], [94, 201, 98], [253, 231, 37]]).float()
_MOST = (2.0, 2.0, 1.0)  # inverse range [1/m], information [nats / 10], inlier probability


def draw_rows(rows: SearchRows, some: list[int], index: Tensor) -> list[np.ndarray]:
    """Pictures (H, W, 3) uint8 of some rows: inverse range, information and inlier probability, one above the other.

    What is not eligible is darker; the cross is the line of sight.
    """
    shape = rows.settings.map_shape
    maps = memory_map(shown_of(rows, some), index, shape).cpu()
    sight = cyclopean(rows.observer.head, Gaze(*(angle[some] for angle in rows.gaze)))[0][..., 2]
    place = (rows.cells[index] @ sight.mT).argmax(0).tolist()
    pictures = []
    for known, at in zip(maps, place, strict=True):
        panels = []
        for channel, most in enumerate(_MOST):
            share = (known[channel] / most).clamp(0, 1) * (len(_COLOURS) - 1)
            low = share.floor().long().clamp(max=len(_COLOURS) - 2)
            colour = torch.lerp(_COLOURS[low], _COLOURS[low + 1], (share - low)[..., None])
            colour = colour * torch.where(known[3] > 0, 1.0, 0.55)[..., None]
            panel = colour.round().byte().repeat_interleave(SCALE, 0).repeat_interleave(SCALE, 1)
            y, x = ((k * SCALE + SCALE // 2) for k in divmod(at, shape[1]))
            panel[y, max(x - SCALE, 0) : x + SCALE + 1] = 255
            panel[max(y - SCALE, 0) : y + SCALE + 1, x] = 255
            panels += [panel, torch.zeros(2, panel.shape[1], 3, dtype=torch.uint8)]
        pictures.append(torch.cat(panels[:-1]).numpy())
    return pictures


def show(picture: np.ndarray) -> None:
    """Show a picture in a window of matplotlib's; without a screen nothing appears.

    Raises:
        ModuleNotFoundError: without matplotlib, the extra `viz`.
    """
    import matplotlib.pyplot as plt

    figure = plt.figure("torchfovea", clear=True)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.imshow(picture)
    axes.set_axis_off()
    figure.canvas.draw()
    if plt.get_backend().lower() not in ("agg", "cairo", "pdf", "pgf", "ps", "svg", "template"):  # those only draw
        plt.pause(1e-3)
